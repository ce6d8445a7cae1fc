"""The lifted Kalman filter: a planar two-link arm's image as a linear system that needs no camera and no link lengths.

With T = alpha F R(theta1 + theta2 + psi)^T, the quantities a = T p_target, b = T p_elbow, d = T (p_tool - p_elbow),
tau = T v obey

    y - y_goal = a - b - d,    J_theta = [S a, S (a - b)],    J_t = tau,    S = [[0, -1], [1, 0]]

whatever the links, the focal length, the depth and the mounting angle are. With a plane vector read as a complex
number u + iv, S is i, and a and b are constants of the world that only turn with the joints:

    a = exp(i (theta1 + theta2)) A,    tau = exp(i (theta1 + theta2)) V,    b = exp(i theta2) B,    d = D.

So the filter's state is [A, V, G, B, D] with G the target's acceleration, it moves by plain kinematics, and joint
motion enters the measurement alone: neither a dropped frame nor a late one costs anything but the target's own
surprise, and encoder noise does not pile up. Offsets of principal point and goal are part of D.

Assumes one image point, known handedness (F), and an optical axis and pixels from which the image differs by a mild
shear: that is covered by a noise in proportion to the error, which vanishes where the target is on its goal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.contract import Increment, ServoMeasurement
from servotrack.estimators.jacobian.lifted_kernel import lifted_update
from servotrack.estimators.types import Array, ComplexArray


class LiftedState(NamedTuple):
    """State of `LiftedKalman`, at the newest frame's instant; M models of the target, L levels of noise.

    Attributes:
        alignment: Encoder history and newest frame.
        mean: [A, V, G, B, D] of each model, u + iv. Shape (*batch, M, 5), px, px/s, px/s^2, px, px.
        covariance: E[x x^H] of each, Hermitian. Shape (*batch, M, 5, 5).
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
    """A `ServoEstimate` that predicts exactly: it turns the arm's vectors instead of following their tangent.

    Attributes:
        target, velocity, acceleration: a, tau and T times the acceleration, u + iv. Shape (*batch,), px, px/s, px/s^2.
        elbow, forearm: b and d. Shape (*batch,), px.
        log_likelihood, surprise: As in `ServoEstimate`. Shape (*batch,).
    """

    target: ComplexArray
    velocity: ComplexArray
    acceleration: ComplexArray
    elbow: ComplexArray
    forearm: ComplexArray
    log_likelihood: Array
    surprise: Array

    @property
    def error(self) -> Array:
        """Features minus goal, now. Shape (*batch, 2), px."""
        return _plane(self.target - self.elbow - self.forearm)

    @property
    def jacobian(self) -> Array:
        """Total image Jacobian [S a, S (a - b), tau], now. Shape (*batch, 2, 3), px/rad, px/rad, px/s."""
        columns = (1j * self.target, 1j * (self.target - self.elbow), self.velocity)
        return np.stack([_plane(column) for column in columns], axis=-1)

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Error after a motion, exactly. Shapes as in `ServoEstimate.predict_error`."""
        dt = np.asarray(duration, dtype=np.float64)
        motion = np.asarray(joint_motion, dtype=np.float64)
        target = self.target + dt * self.velocity + 0.5 * dt * dt * self.acceleration
        turn = np.exp(1j * (motion[..., 0] + motion[..., 1]))
        return _plane(turn * target - np.exp(1j * motion[..., 1]) * self.elbow - self.forearm)


@dataclass(frozen=True)
class TargetModel:
    """How a target may move: V' = G + white acceleration, G' = -recall V - damping G + white jerk.

    Plain constant acceleration has neither recall nor damping; a large damping makes it constant velocity; recall w^2
    makes it an oscillation of w rad/s about a center of its own.

    Args:
        jerk: Root spectral density of the white jerk along each axis, px/s^2.5.
        jump: Root spectral density of the white acceleration along each axis, px/s^1.5.
        recall: 1/s^2.
        damping: 1/s.
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
"""Nothing is supposed of the target but inertia: constant acceleration, calm and agile."""
OCTAVE_MODELS = (*ACCELERATING_MODELS, *(TargetModel(jerk=15.0, recall=rate**2) for rate in (0.35, 0.7, 1.4, 2.8, 5.6)))
"""Constant acceleration, or a swing at a rate that nobody knows: one model an octave, 0.35 to 5.6 rad/s."""
SWINGING_MODELS = (
    TargetModel(jerk=8.0, recall=0.3),
    TargetModel(jerk=8.0, recall=1.0),
    TargetModel(jerk=8.0, recall=2.2),
    TargetModel(jerk=115.0, jump=8.0),
    TargetModel(jerk=100.0, jump=500.0, damping=10.0),
)
"""Slow, middling and fast swings (0.55, 1 and 1.5 rad/s), plain constant acceleration, and the abrupt turn."""


@dataclass(frozen=True)
class LiftedKalman:
    """Lifted Kalman filter with interacting models of the target and noise that it learns.

    Several models of the target run side by side (interacting multiple models), so that a smooth target is averaged
    over many frames and an abrupt manoeuvre is followed at once: a single frame far off is an outlier, the second in
    a row is a manoeuvre. The default lets the target accelerate or swing at any rate over four octaves;
    `ACCELERATING_MODELS` suppose nothing but inertia and are faster; `SWINGING_MODELS` know the rates to be near
    1 rad/s. Give one model, one noise level and `outlier_rate=0` for the plain Kalman filter.

    The defaults are one setting for all levels of the benchmark, from a random search on tune seeds at levels 0 to 5.

    Args:
        models: What the target may do.
        model_stay: Probability that the target keeps its model from frame to frame.
        noise: Levels of the standard deviation of a feature along each axis, px. Their probabilities are learned.
        noise_stay: Probability that a camera keeps its noise level from frame to frame.
        encoder_noise: Standard deviation of a joint angle, rad.
        optics_error: Relative error of the features' distance from the goal, for lens, tilt and pixels that are not
            square.
        outlier_rate: Probability that a frame's features are an outlier.
        outlier_noise: Standard deviation of an outlier along each axis, px.
        drift: Root spectral density of the random walk of A, B and D, px/s^0.5: what residual optics makes of
            constants.
        arm_spread: Standard deviation of A, B and D along each axis before the first frame, px.
        velocity_spread: The same of V, px/s.
        acceleration_spread: The same of G, px/s^2.
        alignment: Interpolates the encoders at the frames' instants.
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
            raise ValueError("models needs at least one TargetModel, got none")
        if not self.noise:
            raise ValueError("noise needs at least one level, px, got none")
        for name in ("noise", "arm_spread", "velocity_spread", "acceleration_spread", "outlier_noise"):
            if not all(0.0 < value < np.inf for value in np.atleast_1d(getattr(self, name))):
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        for name in ("encoder_noise", "optics_error", "drift"):
            if not all(0.0 <= value < np.inf for value in np.atleast_1d(getattr(self, name))):
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")
        for name in ("model_stay", "noise_stay"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} is a probability in (0, 1), got {getattr(self, name)}; 0.98 is usual")
        if not 0.0 <= self.outlier_rate < 1.0:
            raise ValueError(f"outlier_rate is a probability in [0, 1), got {self.outlier_rate}")

    def initial(self, measurement: ServoMeasurement) -> LiftedState:
        """State before the first frame. Raises ValueError as `checked` does, or for not 2 joints and 2 features."""
        alignment = self.alignment.initial(measurement)
        joints, features = alignment.frame_joints.shape[-1], alignment.frame_features.shape[-1]
        if (joints, features) != (2, 2):
            raise ValueError(
                "LiftedKalman serves a planar arm of 2 joints and one image point (2 features), got joint_angles with "
                f"{joints} and features with {features}; use KalmanJacobian"
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
        """Fold one measurement in. Raises ValueError as `Alignment.step` does."""
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
        log_likelihood, surprise = np.zeros(fresh.shape), np.zeros(fresh.shape)
        encoder_error = np.zeros(fresh.shape, dtype=np.complex128)
        offset = alignment.frame_features - goal
        lifted_update(  # type: ignore[call-arg]  # mypy cannot count starred arguments of a compiled function
            new.mean.reshape(-1, *new.mean.shape[-2:]),
            new.covariance.reshape(-1, *new.covariance.shape[-3:]),
            new.model_weight.reshape(-1, len(self.models)),
            new.noise_weight.reshape(-1, len(self.noise)),
            fresh.reshape(-1),
            increment.time.reshape(-1),
            alignment.frame_joints.reshape(-1, 2),
            (offset[..., 0] + 1j * offset[..., 1]).reshape(-1),
            *self._variances(),
            log_likelihood.reshape(-1),
            surprise.reshape(-1),
            encoder_error.reshape(-1),
        )
        # The reading at the frame is the present one only where the frame is not late; a later reading errs anew.
        encoder_error[increment.pending_time > 0.0] = 0.0
        return new, self._present(new, increment, log_likelihood, surprise, encoder_error)

    def forget(self, state: LiftedState) -> LiftedState:
        """Keep the mean, trust it no more: the covariance goes back to the prior's."""
        return state._replace(covariance=np.broadcast_to(self._prior_covariance(), state.covariance.shape).copy())

    def _present(
        self,
        state: LiftedState,
        increment: Increment,
        log_likelihood: Array,
        surprise: Array,
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
            surprise,
        )

    def _prior_covariance(self) -> ComplexArray:
        spread = (self.arm_spread, self.velocity_spread, self.acceleration_spread, self.arm_spread, self.arm_spread)
        return np.diag(2.0 * np.square(spread)).astype(np.complex128)

    def _variances(self) -> tuple[Array | float, ...]:
        """The kernel's parameters. A complex variance is that of both axes together, hence the factors of two."""
        return (
            np.array([(2.0 * m.jerk**2, 2.0 * m.jump**2, m.recall, m.damping) for m in self.models]),
            2.0 * self.drift**2,
            self.model_stay,
            2.0 * np.square(self.noise),
            self.noise_stay,
            np.array([self.encoder_noise**2, self.optics_error**2]),
            self.outlier_rate,
            2.0 * self.outlier_noise**2,
        )


def _plane(vector: ComplexArray) -> Array:
    return np.stack([vector.real, vector.imag], axis=-1)
