"""Parametric filters of the total image Jacobian: the state holds the parameters of arm, camera and target.

The state is x = [log s, psi, rho, p, v, w]: scale s (pixels per first link), mounting angle psi, ratio rho of the
second link to the first, and the target's position, velocity and acceleration in units of the first link. Only these
are observable in images: lengths times k and pixels per length over k leave every pixel unchanged. With phi = theta1 +
theta2 + psi,

    y - y_goal = s F R(phi)^T (p - p_elbow - rho u(theta1 + theta2)),    F = diag(1, -1),  u(t) = (cos t, sin t)

for a goal recorded with the tool above the target. The model is propagated by linearization (extended Kalman filter)
or by sigma points (unscented). It is strongly nonlinear in psi, so a single filter converges only near the right
angle. `HypothesisBank(ParametricKalman(), Mountings())` covers all angles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.definite import keep_definite
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.jacobian.gaussian import correlated_scores
from servotrack.estimators.jacobian.lifted import LiftedEstimate
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array, ComplexArray

STATE_SIZE = 9
"""Numbers in the state: three parameters, then position, velocity and acceleration in the plane."""
LEAST_VARIANCE = 1e-14
"""Variance added to every state after an update, against an indefinite covariance by rounding."""


class ParametricState(NamedTuple):
    """State of a `ParametricKalman`, at the newest frame's instant.

    Attributes:
        alignment: Encoder history and newest frame.
        mean: [log s, psi, rho, p, v, w]. Shape (*batch, 9); lengths in first links.
        covariance: Covariance of the state. Shape (*batch, 9, 9).
    """

    alignment: AlignmentState
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class ParametricKalman:
    """Extended or unscented Kalman filter of camera, links and target.

    The defaults are one setting for all levels of the benchmark, from a random search on tune seeds at levels 0 to 5.

    Args:
        unscented: Use sigma points instead of the linearization; results differ little.
        kappa: Spread parameter of the sigma points, which lie sqrt(9 + kappa) standard deviations from the mean.
        scale: Expected scale s, px per first link.
        scale_spread: Standard deviation of log s before the first frame.
        mounting: Expected mounting angle, rad.
        mounting_spread: Standard deviation of the mounting angle before the first frame, rad.
        ratio_spread: Standard deviation of rho around 1 before the first frame.
        position_spread: Standard deviation of each coordinate of p before the first frame, first links; of v, first
            links/s; and of w, first links/s^2.
        jerk: Root spectral density of the target's white jerk, first links/s^2.5. Larger values follow maneuvers
            faster and average fewer frames.
        drift: Root spectral density of the random walk of log s, psi and rho, 1/s^0.5, which covers the slow changes
            that residual optics causes.
        pixel_noise: Standard deviation of a feature, px.
        encoder_noise: Standard deviation of a joint angle, rad.
        optics_error: Relative error of the features' distance from the goal, for lens distortion, tilt and pixels that
            are not square.
        alignment: Interpolation of the encoder readings at the frames' instants.
        scale_range: Largest deviation of log s from its expected value. Larger values allow more extreme cameras; the
            limit prevents overflow on features that no camera produces.
    """

    unscented: bool = False
    kappa: float = 0.0
    scale: float = 220.0
    scale_spread: float = 0.4
    mounting: float = 0.0
    mounting_spread: float = 0.5
    ratio_spread: float = 0.3
    position_spread: float = 0.45
    jerk: float = 0.3
    drift: float = 0.0011
    pixel_noise: float = 0.55
    encoder_noise: float = 0.0004
    optics_error: float = 0.06
    alignment: Alignment = field(default_factory=Alignment)
    scale_range: float = 5.0

    def __post_init__(self) -> None:
        for name in (
            "scale", "scale_spread", "mounting_spread", "ratio_spread", "position_spread", "pixel_noise", "scale_range",
        ):  # fmt: skip
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        for name in ("jerk", "drift", "encoder_noise", "optics_error"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")
        if not np.isfinite(self.mounting):
            raise ValueError(f"mounting must be finite, got {self.mounting} rad")
        if not -STATE_SIZE < self.kappa < np.inf:
            raise ValueError(f"kappa must be greater than -{STATE_SIZE}, got {self.kappa}")

    def initial(self, measurement: ServoMeasurement, mounting: ArrayLike | None = None) -> ParametricState:
        """State before the first frame, with the target at the position that this frame shows.

        Args:
            measurement: First measurement, which must also be passed to the first `step`.
            mounting: Expected mounting angle that replaces the field; None: the field. Shape (*batch,), rad.

        Raises:
            ValueError: As `checked` does, or unless there are 2 joints and 2 features.
        """
        measurement = checked(measurement)
        joints, features = measurement.joint_angles.shape[-1], measurement.features.shape[-1]
        if (joints, features) != (2, 2):
            raise ValueError(
                "ParametricKalman supports only a planar arm with 2 joints and 1 image point (2 features), got "
                f"joint_angles with {joints} and features with {features}; use KalmanJacobian"
            )
        mean = np.zeros((*measurement.time.shape, STATE_SIZE))
        mean[..., 0], mean[..., 2] = np.log(self.scale), 1.0
        mean[..., 1] = self.mounting if mounting is None else np.asarray(mounting, dtype=np.float64)
        parts = _Parts(mean, measurement.joint_angles)
        offset = np.where(measurement.visible[..., None], measurement.features - measurement.goal, 0.0)
        seen = np.conj((offset[..., 0] + 1j * offset[..., 1]) / parts.turn) + parts.tool
        mean[..., 3], mean[..., 4] = seen.real, seen.imag
        return ParametricState(self.alignment.initial(measurement), mean, self._prior(mean.shape[:-1]))

    def step(self, state: ParametricState, measurement: ServoMeasurement) -> tuple[ParametricState, LiftedEstimate]:
        """Update with one measurement.

        Raises:
            ValueError: As `Alignment.step` does, or if the covariance is no longer positive definite.
        """
        alignment, increment = self.alignment.step(state.alignment, measurement)
        fresh = increment.fresh | (alignment.seen & ~state.alignment.seen)
        mean, covariance = self._predicted(state, increment.time)
        joints = alignment.frame_joints
        offset = alignment.frame_features - np.asarray(measurement.goal, dtype=np.float64)
        if self.unscented:
            expected, cross, spread = self._sigma_points(mean, covariance, joints)
        else:
            expected, cross, spread = self._linearized(mean, covariance, joints)
        innovation = offset - expected
        spread = spread + self._noise(mean, joints)[..., None, None] * np.eye(2)
        # Features that no camera produces make it so large that rounding errors exceed the noise.
        spread = keep_definite(spread, np.abs(np.einsum("...ii->...i", spread)))
        gain = np.swapaxes(np.linalg.solve(spread, np.swapaxes(cross, -1, -2)), -1, -2)
        scores = correlated_scores(innovation, spread, fresh)
        updated = covariance - gain @ spread @ np.swapaxes(gain, -1, -2)
        updated = 0.5 * (updated + np.swapaxes(updated, -1, -2)) + LEAST_VARIANCE * np.eye(STATE_SIZE)
        updated = keep_definite(updated, np.einsum("...ii->...i", covariance))
        corrected = mean + np.einsum("...ij,...j->...i", gain, innovation)
        limit = np.log(self.scale) + self.scale_range * np.array([-1.0, 1.0])
        corrected[..., 0] = np.clip(corrected[..., 0], *limit)
        new = ParametricState(
            alignment,
            np.where(fresh[..., None], corrected, state.mean),
            np.where(fresh[..., None, None], updated, state.covariance),
        )
        estimate = self._present(new, increment.pending_joints, increment.pending_time, *scores)
        return new, estimate

    def forget(self, state: ParametricState) -> ParametricState:
        """Keep the mean and reset the covariance to the prior's."""
        return state._replace(covariance=self._prior(state.mean.shape[:-1]))

    def _prior(self, batch: tuple[int, ...]) -> Array:
        spreads = (self.scale_spread, self.mounting_spread, self.ratio_spread, *(self.position_spread,) * 6)
        return np.tile(np.diag(np.square(spreads)), (*batch, 1, 1))

    def _predicted(self, state: ParametricState, dt: Array) -> tuple[Array, Array]:
        """Predict by constant acceleration with white jerk, and by a random walk of the parameters."""
        one, t = np.eye(2), dt[..., None, None]
        transition = np.tile(np.eye(STATE_SIZE), (*dt.shape, 1, 1))
        noise = np.zeros_like(transition)
        for row in range(3):
            for column in range(row, 3):
                rows, columns = slice(3 + 2 * row, 5 + 2 * row), slice(3 + 2 * column, 5 + 2 * column)
                transition[..., rows, columns] = one * t ** (column - row) / (1.0, 1.0, 2.0)[column - row]
                power = 5 - row - column
                shape = one * self.jerk**2 * t**power / (power * (2.0, 1.0, 1.0)[row] * (2.0, 1.0, 1.0)[column])
                noise[..., rows, columns] = noise[..., columns, rows] = shape
        noise[..., :3, :3] += self.drift**2 * t * np.eye(3)
        mean = np.einsum("...ij,...j->...i", transition, state.mean)
        covariance = transition @ state.covariance @ np.swapaxes(transition, -1, -2) + noise
        return mean, keep_definite(covariance, np.einsum("...ii->...i", state.covariance + noise))

    def _linearized(self, mean: Array, covariance: Array, joints: Array) -> tuple[Array, Array, Array]:
        """Expected features, their covariance with the state and their covariance, by linearization."""
        parts = _Parts(mean, joints)
        error = parts.error
        derivatives = np.zeros((*mean.shape[:-1], 2, STATE_SIZE))
        columns = (error, 1j * error, -parts.turn * np.conj(parts.direction), parts.turn, -1j * parts.turn)
        for k, column in enumerate(columns):
            derivatives[..., 0, k], derivatives[..., 1, k] = column.real, column.imag
        cross = covariance @ np.swapaxes(derivatives, -1, -2)
        return _plane(error), cross, derivatives @ cross

    def _sigma_points(self, mean: Array, covariance: Array, joints: Array) -> tuple[Array, Array, Array]:
        """Expected features and covariances by symmetric sigma points (Zhang 2011, eqs 18 to 27, for this model)."""
        spread = STATE_SIZE + self.kappa
        try:
            root = np.swapaxes(np.linalg.cholesky(spread * covariance), -1, -2)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"the covariance is no longer positive definite at joint_angles {joints}; restart with "
                "initial(measurement), and raise pixel_noise if this happens again"
            ) from None
        center = mean[..., None, :]
        points = np.concatenate([center, center + root, center - root], axis=-2)
        weights = np.full(2 * STATE_SIZE + 1, 0.5 / spread)
        weights[0] = self.kappa / spread
        images = _plane(_Parts(points, joints[..., None, :]).error)
        expected = np.einsum("k,...ki->...i", weights, images)
        deviation = images - expected[..., None, :]
        cross = np.einsum("k,...ki,...kj->...ij", weights, points - center, deviation)
        return expected, cross, np.einsum("k,...ki,...kj->...ij", weights, deviation, deviation)

    def _noise(self, mean: Array, joints: Array) -> Array:
        """Variance of a feature along each axis by pixels, joint angles and residual optics. Shape (*batch,), px^2."""
        parts = _Parts(mean, joints)
        arms = 0.5 * (np.abs(parts.target) ** 2 + np.abs(parts.target - parts.elbow) ** 2)
        return (
            self.pixel_noise**2 + self.encoder_noise**2 * arms + 0.5 * self.optics_error**2 * np.abs(parts.error) ** 2
        )

    def _present(
        self, state: ParametricState, pending_joints: Array, pending_time: Array, log_likelihood: Array, nis: Array
    ) -> LiftedEstimate:
        mean = state.mean.copy()
        t = pending_time[..., None]
        mean[..., 3:5] += t * (mean[..., 5:7] + 0.5 * t * mean[..., 7:9])
        mean[..., 5:7] += t * mean[..., 7:9]
        parts = _Parts(mean, state.alignment.frame_joints + pending_joints)
        velocity = parts.turn * (mean[..., 5] - 1j * mean[..., 6])
        acceleration = parts.turn * (mean[..., 7] - 1j * mean[..., 8])
        return LiftedEstimate(parts.target, velocity, acceleration, parts.elbow, parts.forearm, log_likelihood, nis)


class _Parts:
    """Lifted vectors of states (*batch, 9) and joint angles, written u + iv; T p = turn conj(p)."""

    def __init__(self, mean: Array, joints: Array) -> None:
        angle = joints.sum(axis=-1)
        self.direction = np.exp(1j * angle)
        self.turn = np.exp(mean[..., 0] + 1j * (angle + mean[..., 1]))
        self.tool = np.exp(1j * joints[..., 0]) + mean[..., 2] * self.direction
        self.target: ComplexArray = self.turn * (mean[..., 3] - 1j * mean[..., 4])
        self.elbow: ComplexArray = self.turn * np.exp(-1j * joints[..., 0])
        self.forearm: ComplexArray = self.turn * mean[..., 2] * np.conj(self.direction)

    @property
    def error(self) -> ComplexArray:
        """Features minus goal, u + iv, px. Shape (*batch,)."""
        return self.target - self.elbow - self.forearm


def _plane(vector: ComplexArray) -> Array:
    return np.stack([vector.real, vector.imag], axis=-1)
