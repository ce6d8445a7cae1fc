"""Level Kalman filter: the features are part of the state, beside the Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.robust import OutlierModel, robust_variance
from servotrack.estimators.jacobian.shared_covariance import interval, shared_update
from servotrack.estimators.types import Array


class LevelState(NamedTuple):
    """State of `LevelKalmanJacobian`.

    Attributes:
        alignment: Encoder history and newest frame.
        mean: Rows [y_i, J_i]. Shape (*batch, m, n + 2), px, px/rad and px/s.
        covariance: Covariance of every row of `mean`. Shape (*batch, n + 2, n + 2).
    """

    alignment: AlignmentState
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class LevelKalmanJacobian:
    """Kalman filter on [y, J]: y' = y + J ds + u, J' = J + w, measured is y.

    The noise of one pixel enters two successive differences dy with opposite signs; filters on dy treat it as
    independent noise. Here each pixel is measured once, so the noise is uncorrelated, and the control law receives a
    filtered error.

    Args:
        walk: Process noise of the Jacobian; larger values follow changes faster and average fewer frames.
        pixel_noise: Standard deviation of a measured feature, px.
        curvature_noise: Standard deviation of u within one `walk.period`, px: the error of the linearization J ds.
        outliers: Noise model that raises the variance of a frame with a large innovation: `StudentTNoise` or
            `CorrentropyNoise`; None disables it.
        prior: Mean and spread of the Jacobian before the first frame.
        alignment: Pairing of joints and features by time stamps.
    """

    walk: RandomWalk = field(default_factory=lambda: RandomWalk(joint_noise=6.0, time_noise=20.0))
    pixel_noise: float = 1.0
    curvature_noise: float = 0.2
    outliers: OutlierModel | None = None
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not 0.0 < self.pixel_noise < np.inf:
            raise ValueError(f"pixel_noise must be finite and > 0 px, got {self.pixel_noise}")
        if not 0.0 <= self.curvature_noise < np.inf:
            raise ValueError(f"curvature_noise must be finite and >= 0 px, got {self.curvature_noise}")

    def initial(self, measurement: ServoMeasurement) -> LevelState:
        """State before the first frame. Raises ValueError as `checked` does."""
        alignment = self.alignment.initial(measurement)
        jacobian, by_row = self.prior.moments(alignment)
        mean = np.concatenate([alignment.frame_features[..., None], jacobian], axis=-1)
        covariance = np.zeros((*by_row.shape[:-2], mean.shape[-1], mean.shape[-1]))
        covariance[..., 0, 0] = self.pixel_noise**2
        covariance[..., 1:, 1:] = by_row
        return LevelState(alignment, mean, covariance)

    def step(self, state: LevelState, measurement: ServoMeasurement) -> tuple[LevelState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        mean, covariance = self._predicted(state, interval(increment), increment.time)
        level = np.zeros(mean.shape[:-2] + mean.shape[-1:])
        level[..., 0] = 1.0

        variance = robust_variance(
            self.outliers, mean, covariance, level, alignment.frame_features, self.pixel_noise**2
        )
        updated = shared_update(mean, covariance, level, alignment.frame_features, variance, increment.fresh)

        # The first frame sets the features; there is no prediction yet to weigh it against.
        first = alignment.seen & ~state.alignment.seen
        mean = updated.mean
        mean[..., 0] = np.where(first[..., None], alignment.frame_features, mean[..., 0])
        estimate = present_estimate(
            mean[..., 0], mean[..., 1:], increment, measurement.goal, updated.log_likelihood, updated.nis
        )
        return LevelState(alignment, mean, updated.covariance), estimate

    def forget(self, state: LevelState) -> LevelState:
        """Keep the mean Jacobian, reset its covariance to the prior's, and take the features from the newest frame."""
        covariance = np.zeros_like(state.covariance)
        covariance[..., 0, 0] = self.pixel_noise**2
        covariance[..., 1:, 1:] = self.prior.moments(state.alignment)[1]
        mean = state.mean.copy()
        mean[..., 0] = state.alignment.frame_features
        return state._replace(mean=mean, covariance=covariance)

    def _predicted(self, state: LevelState, ds: Array, duration: Array) -> tuple[Array, Array]:
        mean = state.mean.copy()
        mean[..., 0] += np.einsum("...ij,...j->...i", state.mean[..., 1:], ds)
        F = np.tile(np.eye(mean.shape[-1]), (*duration.shape, 1, 1))
        F[..., 0, 1:] = ds
        covariance = np.einsum("...ij,...jk,...lk->...il", F, state.covariance, F)
        walk = self.walk.variances(ds.shape[-1] - 1)
        noise = np.append(self.curvature_noise**2, walk) * (duration / self.walk.period)[..., None]
        diagonal = np.einsum("...ii->...i", covariance)
        diagonal += noise
        return mean, covariance
