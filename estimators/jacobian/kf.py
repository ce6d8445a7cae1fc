"""The Kalman filter of the total image Jacobian (Zhang 2011, eq. 9), with one covariance for all rows."""

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


class KalmanState(NamedTuple):
    """State of the filters that keep one covariance for all rows of the Jacobian.

    Attributes:
        alignment: Encoder history and newest frame.
        jacobian: Mean. Shape (*batch, m, n + 1), px/rad and px/s.
        covariance: Covariance of every row of `jacobian`. Shape (*batch, n + 1, n + 1).
    """

    alignment: AlignmentState
    jacobian: Array
    covariance: Array


@dataclass(frozen=True)
class KalmanJacobian:
    """Kalman filter on x' = x + w, dy = J ds + v with isotropic v (Zhang 2011, eq. 9).

    Args:
        walk: Process noise of the Jacobian; larger values follow changes faster and average fewer frames.
        measurement_noise: Standard deviation of dy about J ds, px: pixel noise of two frames and the curvature of the
            motion. Larger values average more increments.
        outliers: Noise model that raises the variance of an increment with a large innovation: `StudentTNoise` or
            `CorrentropyNoise`; None disables it.
        prior: Mean and spread of the Jacobian before the first increment.
        alignment: Pairing of joints and features by time stamps.
    """

    walk: RandomWalk = field(default_factory=RandomWalk)
    measurement_noise: float = 3.0
    outliers: OutlierModel | None = None
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not 0.0 < self.measurement_noise < np.inf:
            raise ValueError(f"measurement_noise must be finite and > 0 px, got {self.measurement_noise}")

    def initial(self, measurement: ServoMeasurement) -> KalmanState:
        """State before the first increment. Raises ValueError as `checked` does."""
        alignment = self.alignment.initial(measurement)
        return KalmanState(alignment, *self.prior.moments(alignment))

    def step(self, state: KalmanState, measurement: ServoMeasurement) -> tuple[KalmanState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        predicted = self.walk.widened(state.covariance, increment.time)
        ds = interval(increment)
        variance = robust_variance(
            self.outliers, state.jacobian, predicted, ds, increment.features, self.measurement_noise**2
        )
        updated = shared_update(state.jacobian, predicted, ds, increment.features, variance, increment.fresh)
        estimate = present_estimate(
            alignment.frame_features,
            updated.mean,
            increment,
            measurement.goal,
            updated.log_likelihood,
            updated.nis,
        )
        return KalmanState(alignment, updated.mean, updated.covariance), estimate

    def forget(self, state: KalmanState) -> KalmanState:
        """Keep the mean and reset the covariance to the prior's."""
        return state._replace(covariance=self.prior.moments(state.alignment)[1])
