"""The unscented Kalman filter of the total image Jacobian, equation by equation (Zhang 2011, eqs 18 to 31)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servotrack.estimators.definite import keep_definite
from servotrack.estimators.jacobian.alignment import Alignment, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.full_kf import FullState, observation_matrix, repeated_blocks
from servotrack.estimators.jacobian.gaussian import correlated_scores
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.shared_covariance import interval
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class UnscentedJacobian:
    """Unscented Kalman filter on the augmented state [x; w; v] with symmetric sigma points.

    The model is linear, so with the same noise levels the result equals that of `KalmanJacobian` up to rounding for
    every kappa. Only `as_printed` makes a difference.

    Args:
        walk: Process noise of the Jacobian; its variances are those of w.
        measurement_noise: Standard deviation of dy about J ds, px; its square is the variance of v.
        kappa: Spread parameter of the sigma points, above -L with L = 2 m (n + 1) + m. Larger values move the points
            away from the mean.
        as_printed: Use the blocks of eq. (21) as printed, which exchange the measurement variance and the process
            variance (contrary to eqs 16 and 17). It requires joint_noise equal to time_noise.
        prior: Mean and spread of the Jacobian before the first increment.
        alignment: Pairing of joints and features by time stamps.
    """

    walk: RandomWalk = field(default_factory=RandomWalk)
    measurement_noise: float = 3.0
    kappa: float = 0.0
    as_printed: bool = False
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not 0.0 < self.measurement_noise < np.inf:
            raise ValueError(f"measurement_noise must be finite and > 0 px, got {self.measurement_noise}")
        if self.as_printed and self.walk.joint_noise != self.walk.time_noise:
            raise ValueError(
                "as_printed exchanges one process variance with one measurement variance, got "
                f"joint_noise {self.walk.joint_noise} and time_noise {self.walk.time_noise}; make them equal"
            )

    def initial(self, measurement: ServoMeasurement) -> FullState:
        """State before the first increment (eqs 18 to 20).

        Raises:
            ValueError: As `checked` does, or if `kappa` is too small for the number of joints and features.
        """
        alignment = self.alignment.initial(measurement)
        mean, row = self.prior.moments(alignment)
        m, columns = mean.shape[-2:]
        L = 2 * m * columns + m
        if not -L < self.kappa < np.inf:
            raise ValueError(
                f"kappa must be finite and > -L = {-L} for {columns - 1} joints and {m} features, got {self.kappa}"
            )
        return FullState(alignment, mean, repeated_blocks(row, m))

    def step(self, state: FullState, measurement: ServoMeasurement) -> tuple[FullState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        *batch, m, columns = state.jacobian.shape
        D = m * columns
        x = state.jacobian.reshape(*batch, D)
        process, noise = self._deviations(columns - 1, m, increment.time)

        points, weights = sigma_points(x, state.covariance, process, noise, self.kappa)
        chi = points[..., :D] + points[..., D : 2 * D]  # eq. 22
        x_predicted = np.einsum("i,...ij->...j", weights, chi)  # eq. 23
        dx = chi - x_predicted[..., None, :]
        P_predicted = np.einsum("i,...ij,...ik->...jk", weights, dx, dx)  # eq. 24
        H = observation_matrix(interval(increment), m)
        z = np.einsum("...kj,...ij->...ik", H, chi) + points[..., 2 * D :]  # eq. 25
        z_predicted = np.einsum("i,...ij->...j", weights, z)  # eq. 26
        dz = z - z_predicted[..., None, :]
        P_vv = np.einsum("i,...ij,...ik->...jk", weights, dz, dz)  # eq. 27
        P_xv = np.einsum("i,...ij,...ik->...jk", weights, dx, dz)  # eq. 28
        W = np.swapaxes(np.linalg.solve(P_vv, np.swapaxes(P_xv, -1, -2)), -1, -2)  # eq. 29
        innovation = increment.features - z_predicted
        x_updated = x_predicted + np.einsum("...ij,...j->...i", W, innovation)  # eq. 30
        P_updated = P_predicted - np.einsum("...ij,...jk,...lk->...il", W, P_vv, W)  # eq. 31

        P_updated = keep_definite(
            0.5 * (P_updated + np.swapaxes(P_updated, -1, -2)), np.einsum("...ii->...i", P_predicted)
        )
        updated = (x_updated.reshape(state.jacobian.shape), P_updated)
        mean, covariance = select_rows(increment.fresh, updated, (state.jacobian, state.covariance))
        scores = correlated_scores(innovation, P_vv, increment.fresh)
        estimate = present_estimate(alignment.frame_features, mean, increment, measurement.goal, *scores)
        return FullState(alignment, mean, covariance), estimate

    def forget(self, state: FullState) -> FullState:
        """Keep the mean and reset the covariance to the prior's."""
        mean, row = self.prior.moments(state.alignment)
        return state._replace(covariance=repeated_blocks(row, mean.shape[-2]))

    def _deviations(self, joints: int, features: int, duration: Array) -> tuple[Array, Array]:
        """Standard deviations of w and v. Shapes (*batch, m (n + 1)) and (*batch, m)."""
        walk, noise = self.walk, self.measurement_noise
        if self.as_printed:
            walk, noise = RandomWalk(noise, noise, walk.period), walk.joint_noise
        return np.tile(walk.deviations(joints, duration), features), np.full((*duration.shape, features), noise)


def sigma_points(mean: Array, covariance: Array, process: Array, noise: Array, kappa: float) -> tuple[Array, Array]:
    """Symmetric sigma points of [x; w; v] (Zhang 2011, eqs 20 and 21; Julier and Uhlmann 2004).

    Args:
        mean: Mean of x. Shape (*batch, D).
        covariance: Covariance of x. Shape (*batch, D, D).
        process: Standard deviations of w. Shape (*batch, D).
        noise: Standard deviations of v. Shape (*batch, m).
        kappa: Spread parameter; the points lie sqrt(L + kappa) standard deviations from the mean.

    Returns:
        2 L + 1 points, shape (*batch, 2 L + 1, L) with L = 2 D + m, and their weights, shape (2 L + 1,).
    """
    *batch, D = mean.shape
    m = noise.shape[-1]
    L = 2 * D + m
    root = np.zeros((*batch, L, L))
    root[..., :D, :D] = np.linalg.cholesky(covariance)
    others = np.arange(D, L)
    root[..., others, others] = np.concatenate([process, noise], axis=-1)
    center = np.concatenate([mean, np.zeros((*batch, D + m))], axis=-1)[..., None, :]
    spread = np.sqrt(L + kappa) * np.swapaxes(root, -1, -2)
    points = np.concatenate([center, center + spread, center - spread], axis=-2)
    weights = np.full(2 * L + 1, 0.5 / (L + kappa))
    weights[0] = kappa / (L + kappa)
    return points, weights
