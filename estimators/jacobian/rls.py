"""Recursive least squares with forgetting."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.kf import KalmanState
from servotrack.estimators.jacobian.prior import JacobianPrior
from servotrack.estimators.jacobian.shared_covariance import interval, shared_update
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares on dy = J ds with exponential forgetting (Ljung 1999, section 11.2).

    Forgetting stops at the prior: without motion in a direction, the variance of a column grows only to the prior's
    instead of winding up.

    Args:
        forgetting: Weight of past increments after one `period`, in (0, 1]. Larger values average more increments; 1
            is the Kalman filter of a constant Jacobian.
        period: Reference interval of `forgetting`, s.
        measurement_noise: Standard deviation of dy about J ds, px.
        prior: Mean and spread of the Jacobian before the first increment.
        alignment: Pairing of joints and features by time stamps.
    """

    forgetting: float = 0.85
    period: float = 0.05
    measurement_noise: float = 6.0
    prior: JacobianPrior = field(default_factory=lambda: JacobianPrior(time_spread=400.0))
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not 0.0 < self.forgetting <= 1.0:
            raise ValueError(f"forgetting must be in (0, 1], got {self.forgetting}")
        for name, value in (("period", self.period), ("measurement_noise", self.measurement_noise)):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")

    def initial(self, measurement: ServoMeasurement) -> KalmanState:
        """State before the first increment. Raises ValueError as `checked` does."""
        alignment = self.alignment.initial(measurement)
        return KalmanState(alignment, *self.prior.moments(alignment))

    def step(self, state: KalmanState, measurement: ServoMeasurement) -> tuple[KalmanState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        updated = shared_update(
            state.jacobian,
            self._forgotten(state.covariance, increment.time),
            interval(increment),
            increment.features,
            self.measurement_noise**2,
            increment.fresh,
        )
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

    def _forgotten(self, covariance: Array, duration: Array) -> Array:
        """P / forgetting, limited to the prior column by column. A congruence, so P stays positive definite."""
        deviation = np.sqrt(np.einsum("...ii->...i", covariance))
        room = np.maximum(self.prior.deviations(covariance.shape[-1] - 1) / deviation, 1.0)
        # After a very long pause the power overflows, and the limit is the prior.
        with np.errstate(over="ignore"):
            growth = np.minimum(self.forgetting ** (-0.5 * duration / self.period)[..., None], room)
        return covariance * growth[..., :, None] * growth[..., None, :]
