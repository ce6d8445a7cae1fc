"""Lifted Kalman filter: the image of a planar two-link arm as a linear system, without camera model or link lengths.

With T = alpha F R(theta1 + theta2 + psi)^T, the quantities a = T p_target, b = T p_elbow, d = T (p_tool - p_elbow),
tau = T v obey

    y - y_goal = a - b - d,    J_theta = [S a, S (a - b)],    J_t = tau,    S = [[0, -1], [1, 0]]

for any link lengths, focal length, depth and mounting angle. With a plane vector written as a complex number u + iv,
S is i, and a and b are constants of the scene that only rotate with the joints:

    a = exp(i (theta1 + theta2)) A,    tau = exp(i (theta1 + theta2)) V,    b = exp(i theta2) B,    d = D.

So the filter's state is [A, V, G, B, D] with G the target's acceleration. It moves by target kinematics alone; joint
motion enters only the measurement. A dropped or late frame therefore adds only the uncertainty of the target's motion,
and encoder noise does not accumulate. Offsets of principal point and goal are part of D.

Assumptions: one image point, known handedness (F), and an image that differs from the model by a mild shear at most
(tilted optical axis, pixels that are not square). Noise in proportion to the error covers the shear; it vanishes where
the target is at its goal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.contract import Increment, ServoMeasurement
from servotrack.estimators.jacobian.lifted_kernel import LiftedParameters, LiftedScores, lifted_update
from servotrack.estimators.types import Array, ComplexArray


class LiftedState(NamedTuple):
    """State of `LiftedKalman` at the newest frame's instant, for M target models and L noise levels.

    Attributes:
        alignment: Encoder history and newest frame.
        mean: [A, V, G, B, D] of each model, u + iv. Shape (*batch, M, 5), px, px/s, px/s^2, px, px.
        covariance: E[x x^H] of each model's state error, Hermitian. Shape (*batch, M, 5, 5).
        model_weight: Probability of each model. Shape (*batch, M).
        noise_weight: Probability of each noise level. Shape (*batch, L).
    """

    alignment: AlignmentState
    mean: ComplexArray
    covariance: ComplexArray
    model_weight: Array
    noise_weight: Array


@dataclass(frozen=True)
class LiftedEstimate:
    """`ServoEstimate` with exact prediction: it rotates the arm's vectors instead of linearizing.

    Attributes:
        target, velocity, acceleration: a, tau and T times the acceleration, u + iv. Shape (*batch,), px, px/s, px/s^2.
        elbow, forearm: b and d, u + iv. Shape (*batch,), px.
        log_likelihood, nis: Log density and NIS of the newest frame, see `ServoEstimate`. Shape (*batch,).
    """

    target: ComplexArray
    velocity: ComplexArray
    acceleration: ComplexArray
    elbow: ComplexArray
    forearm: ComplexArray
    log_likelihood: Array
    nis: Array

    @property
    def error(self) -> Array:
        """Features minus goal at present. Shape (*batch, 2), px."""
        return _plane(self.target - self.elbow - self.forearm)

    @property
    def jacobian(self) -> Array:
        """Total image Jacobian [S a, S (a - b), tau] at present. Shape (*batch, 2, 3), px/rad, px/rad, px/s."""
        columns = (1j * self.target, 1j * (self.target - self.elbow), self.velocity)
        return np.stack([_plane(column) for column in columns], axis=-1)

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Predict the error after a motion, exactly. Arguments as in `ServoEstimate.predict_error`."""
        dt = np.asarray(duration, dtype=np.float64)
        motion = np.asarray(joint_motion, dtype=np.float64)
        target = self.target + dt * self.velocity + 0.5 * dt * dt * self.acceleration
        turn = np.exp(1j * (motion[..., 0] + motion[..., 1]))
        return _plane(turn * target - np.exp(1j * motion[..., 1]) * self.elbow - self.forearm)


@dataclass(frozen=True)
class TargetModel:
    """Motion model of a target: V' = G + white acceleration, G' = -recall V - damping G + white jerk.

    Constant acceleration has recall 0 and damping 0. A large damping gives constant velocity. A recall of w^2 gives an
    oscillation of w rad/s.

    Args:
        jerk: Root spectral density of the white jerk along each axis, px/s^2.5. Larger values follow changes of
            acceleration faster and average fewer frames.
        jump: Root spectral density of the white acceleration along each axis, px/s^1.5. Larger values follow sudden
            changes of velocity faster.
        recall: Restoring coefficient of the velocity, 1/s^2.
        damping: Decay rate of the acceleration, 1/s.
    """

    jerk: float
    jump: float = 0.0
    recall: float = 0.0
    damping: float = 0.0

    def __post_init__(self) -> None:
        for name in ("jerk", "jump", "recall", "damping"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")


ACCELERATING_MODELS = (TargetModel(jerk=60.0), TargetModel(jerk=200.0, jump=200.0))
"""Constant acceleration with small and with large process noise; no periodic motion is assumed."""
OCTAVE_MODELS = (*ACCELERATING_MODELS, *(TargetModel(jerk=15.0, recall=rate**2) for rate in (0.35, 0.7, 1.4, 2.8, 5.6)))
"""Constant acceleration, or an oscillation of unknown rate: one model per octave, 0.35 to 5.6 rad/s."""
AGILE_MODELS = tuple(TargetModel(jerk=10.0, jump=jump, damping=10.0) for jump in (20.0, 100.0, 600.0))
"""Constant velocity that changes slowly, fast, and abruptly; no periodic motion is assumed."""
SWINGING_MODELS = (
    TargetModel(jerk=8.0, recall=0.3),
    TargetModel(jerk=8.0, recall=1.0),
    TargetModel(jerk=8.0, recall=2.2),
    TargetModel(jerk=115.0, jump=8.0),
    TargetModel(jerk=100.0, jump=500.0, damping=10.0),
)
"""Oscillations of 0.55, 1 and 1.5 rad/s, constant acceleration, and abrupt turns."""


@dataclass(frozen=True)
class LiftedKalman:
    """Lifted Kalman filter with interacting multiple models (IMM) of the target and adaptive measurement noise.

    Several target models run side by side, so that a smooth target is averaged over many frames and an abrupt maneuver
    is followed at once: one frame with a large innovation counts as an outlier, a second one in a row as a maneuver.
    The default models let the target accelerate or oscillate at any rate over four octaves. `ACCELERATING_MODELS`
    assume no oscillation and are faster; `SWINGING_MODELS` assume rates near 1 rad/s. One model, one noise level and
    `outlier_rate=0` give the plain Kalman filter.

    The defaults are one setting for all levels of the benchmark, from a random search on tune seeds at levels 0 to 5.

    Args:
        models: Motion models of the target. Computing time grows in proportion to their number.
        model_stay: Probability that the target keeps its model from frame to frame. Larger values switch later.
        noise: Levels of the standard deviation of a feature along each axis, px. Their probabilities are estimated
            online.
        noise_stay: Probability that the camera keeps its noise level from frame to frame. Larger values adapt the
            noise more slowly.
        encoder_noise: Standard deviation of a joint angle, rad.
        optics_error: Relative error of the features' distance from the goal, for lens distortion, tilt and pixels that
            are not square. Larger values trust features far from the goal less.
        outlier_rate: Probability that a frame's features are an outlier.
        outlier_noise: Standard deviation of an outlier along each axis, px.
        drift: Root spectral density of the random walk of A, B and D, px/s^0.5, which covers the slow changes that
            residual optics causes. Larger values re-learn the arm faster and less accurately.
        arm_spread: Standard deviation of A, B and D along each axis before the first frame, px.
        velocity_spread: Standard deviation of V along each axis before the first frame, px/s.
        acceleration_spread: Standard deviation of G along each axis before the first frame, px/s^2.
        alignment: Interpolation of the encoder readings at the frames' instants.
    """

    models: tuple[TargetModel, ...] = OCTAVE_MODELS
    model_stay: float = 0.98
    noise: tuple[float, ...] = (0.3, 0.7, 1.5, 3.0)
    noise_stay: float = 0.985
    encoder_noise: float = 0.0008
    optics_error: float = 0.025
    outlier_rate: float = 0.015
    outlier_noise: float = 30.0
    drift: float = 0.15
    arm_spread: float = 300.0
    velocity_spread: float = 150.0
    acceleration_spread: float = 150.0
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not self.models:
            raise ValueError("models must have at least one TargetModel, got none")
        if not self.noise:
            raise ValueError("noise must have at least one level in px, got none")
        for name in ("noise", "arm_spread", "velocity_spread", "acceleration_spread", "outlier_noise"):
            if not all(0.0 < value < np.inf for value in np.atleast_1d(getattr(self, name))):
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        for name in ("encoder_noise", "optics_error", "drift"):
            if not all(0.0 <= value < np.inf for value in np.atleast_1d(getattr(self, name))):
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")
        for name in ("model_stay", "noise_stay"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be a probability in (0, 1), got {getattr(self, name)}; 0.98 is usual")
        if not 0.0 <= self.outlier_rate < 1.0:
            raise ValueError(f"outlier_rate must be a probability in [0, 1), got {self.outlier_rate}")

    def initial(self, measurement: ServoMeasurement) -> LiftedState:
        """State before the first frame.

        Raises:
            ValueError: As `checked` does, or unless there are 2 joints and 2 features.
        """
        alignment = self.alignment.initial(measurement)
        joints, features = alignment.frame_joints.shape[-1], alignment.frame_features.shape[-1]
        if (joints, features) != (2, 2):
            raise ValueError(
                "LiftedKalman supports only a planar arm with 2 joints and 1 image point (2 features), got "
                f"joint_angles with {joints} and features with {features}; use KalmanJacobian"
            )
        batch, models, levels = alignment.seen.shape, len(self.models), len(self.noise)
        return LiftedState(
            alignment,
            np.zeros((*batch, models, 5), dtype=np.complex128),
            np.tile(self._prior_covariance(), (*batch, models, 1, 1)),
            np.full((*batch, models), 1.0 / models),
            np.full((*batch, levels), 1.0 / levels),
        )

    def step(self, state: LiftedState, measurement: ServoMeasurement) -> tuple[LiftedState, LiftedEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        fresh = increment.fresh | (alignment.seen & ~state.alignment.seen)
        goal = np.asarray(measurement.goal, dtype=np.float64)
        new = LiftedState(
            alignment,
            state.mean.copy(),
            state.covariance.copy(),
            state.model_weight.copy(),
            state.noise_weight.copy(),
        )
        log_likelihood, nis = np.zeros(fresh.shape), np.zeros(fresh.shape)
        encoder_error = np.zeros(fresh.shape, dtype=np.complex128)
        offset = alignment.frame_features - goal
        lifted_update(
            new.mean.reshape(-1, *new.mean.shape[-2:]),
            new.covariance.reshape(-1, *new.covariance.shape[-3:]),
            new.model_weight.reshape(-1, len(self.models)),
            new.noise_weight.reshape(-1, len(self.noise)),
            fresh.reshape(-1),
            increment.time.reshape(-1),
            alignment.frame_joints.reshape(-1, 2),
            (offset[..., 0] + 1j * offset[..., 1]).reshape(-1),
            self._kernel_parameters(),
            LiftedScores(log_likelihood.reshape(-1), nis.reshape(-1), encoder_error.reshape(-1)),
        )
        # Encoder noise at the frame equals that of the present reading only if the frame has no latency.
        encoder_error[increment.pending_time > 0.0] = 0.0
        return new, self._present(new, increment, log_likelihood, nis, encoder_error)

    def forget(self, state: LiftedState) -> LiftedState:
        """Keep the mean and reset the covariance to the prior's."""
        return state._replace(covariance=np.broadcast_to(self._prior_covariance(), state.covariance.shape).copy())

    def _present(
        self,
        state: LiftedState,
        increment: Increment,
        log_likelihood: Array,
        nis: Array,
        encoder_error: ComplexArray,
    ) -> LiftedEstimate:
        mean = np.einsum("...m,...ms->...s", state.model_weight, state.mean)
        joints = state.alignment.frame_joints + increment.pending_joints
        age = increment.pending_time
        turn, swing = np.exp(1j * joints.sum(axis=-1)), np.exp(1j * joints[..., 1])
        velocity = mean[..., 1] + age * mean[..., 2]
        target = mean[..., 0] + age * (mean[..., 1] + 0.5 * age * mean[..., 2])
        forearm = mean[..., 4] - encoder_error
        return LiftedEstimate(
            turn * target,
            turn * velocity,
            turn * mean[..., 2],
            swing * mean[..., 3],
            forearm,
            log_likelihood,
            nis,
        )

    def _prior_covariance(self) -> ComplexArray:
        spread = (self.arm_spread, self.velocity_spread, self.acceleration_spread, self.arm_spread, self.arm_spread)
        return np.diag(2.0 * np.square(spread)).astype(np.complex128)

    def _kernel_parameters(self) -> LiftedParameters:
        """Parameters of the kernel. The variance of a complex number sums both axes, hence the factors of two."""
        return LiftedParameters(
            models=np.array([(2.0 * m.jerk**2, 2.0 * m.jump**2, m.recall, m.damping) for m in self.models]),
            drift=2.0 * self.drift**2,
            model_stay=self.model_stay,
            noise=2.0 * np.square(self.noise),
            noise_stay=self.noise_stay,
            encoder_variance=float(self.encoder_noise**2),
            optics_variance=float(self.optics_error**2),
            outlier_rate=float(self.outlier_rate),
            outlier_variance=2.0 * self.outlier_noise**2,
        )


def _plane(vector: ComplexArray) -> Array:
    return np.stack([vector.real, vector.imag], axis=-1)
