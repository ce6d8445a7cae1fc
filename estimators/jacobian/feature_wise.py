"""Features that come and go one by one: a filter of its own for every row of the total image Jacobian.

With isotropic noise the rows of J are independent. A point that leaves the image or is hidden then takes nothing from
the others, and its own row goes on from the frame that showed it last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.jacobian.contract import JacobianEstimator, LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array


class FeatureWiseState(NamedTuple):
    """State of `FeatureWise`.

    Attributes:
        rows: State of the estimator with batch axes (*batch, m).
    """

    rows: Any


def each_feature(measurement: ServoMeasurement) -> ServoMeasurement:
    """Split a measurement into one per feature.

    Args:
        measurement: Measurement with m features, of which each may have an entry of `visible` of its own.

    Returns:
        Measurement with batch axes (*batch, m) and one feature.

    Raises:
        ValueError: As `checked` does.
    """
    whole = checked(measurement, each_feature=True)
    *batch, m = whole.features.shape
    n, axis = whole.joint_angles.shape[-1], len(batch)

    def repeated(values: Array) -> Array:
        return np.repeat(np.expand_dims(values, axis), m, axis)

    unseen = ~whole.visible
    return ServoMeasurement(
        np.broadcast_to(whole.joint_angles[..., None, :], (*batch, m, n)).copy(),
        np.where(unseen, 0.0, whole.features)[..., None],
        whole.goal[..., None],
        whole.visible,
        repeated(whole.frame_time),
        repeated(whole.time),
        None if whole.joint_time is None else repeated(whole.joint_time),
    )


@dataclass(frozen=True)
class FeatureWise:
    """Estimator of every row of the Jacobian alone, for measurements in which features are seen one by one.

    `ServoMeasurement.visible` may then have one entry per feature or per point, and a NaN counts as unseen. An
    increment of a feature spans the time since the last frame that showed it.

    Args:
        estimator: Estimator with linear prediction that works with any number of features, such as `KalmanJacobian`.
            Each feature has a copy.
    """

    estimator: JacobianEstimator

    def initial(self, measurement: ServoMeasurement) -> FeatureWiseState:
        """State before the first frame. Raises ValueError as `checked` and the estimator do."""
        return FeatureWiseState(self.estimator.initial(each_feature(measurement)))

    def step(self, state: FeatureWiseState, measurement: ServoMeasurement) -> tuple[FeatureWiseState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `checked` and the estimator do."""
        rows, estimate = self.estimator.step(state.rows, each_feature(measurement))
        used = np.maximum(np.count_nonzero(estimate.nis, axis=-1), 1)
        covariance, variance = getattr(estimate, "covariance", None), getattr(estimate, "error_variance", None)
        return FeatureWiseState(rows), LinearEstimate(
            error=estimate.error[..., 0],
            jacobian=estimate.jacobian[..., 0, :],
            log_likelihood=estimate.log_likelihood.sum(axis=-1),
            nis=estimate.nis.sum(axis=-1) / used,
            covariance=None if covariance is None else covariance[..., 0, :, :],
            error_variance=None if variance is None else variance[..., 0],
        )

    def forget(self, state: FeatureWiseState) -> FeatureWiseState:
        """Reset the covariances to the prior's, if the estimator can; the means stay."""
        forget = getattr(self.estimator, "forget", None)
        return state if forget is None else FeatureWiseState(forget(state.rows))
