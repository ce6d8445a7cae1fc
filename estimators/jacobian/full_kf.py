"""The Kalman filter of the total image Jacobian with one covariance over all its entries (Zhang 2011, eq. 9)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.definite import keep_definite
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.gaussian import correlated_scores, require_positive_definite
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.shared_covariance import interval
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array


class FullState(NamedTuple):
    """State of the filters that keep one covariance over all entries of the Jacobian.

    Attributes:
        alignment: Encoder history and newest frame.
        jacobian: Mean. Shape (*batch, m, n + 1), px/rad and px/s.
        covariance: Covariance of x, the rows of `jacobian` one after another. Shape (*batch, m (n + 1), m (n + 1)).
    """

    alignment: AlignmentState
    jacobian: Array
    covariance: Array


@dataclass(frozen=True)
class FullKalmanJacobian:
    """Kalman filter for noise that differs or is correlated between features; slower than `KalmanJacobian`.

    Args:
        measurement_covariance: Covariance of dy about J ds; a number is the variance of independent features. Larger
            values average more increments. Shape (m, m), px^2.
        walk: Process noise of the Jacobian; larger values follow changes faster and average fewer frames.
        prior: Mean and spread of the Jacobian before the first increment.
        alignment: Pairing of joints and features by time stamps.
    """

    measurement_covariance: float | tuple[tuple[float, ...], ...] = 9.0
    walk: RandomWalk = field(default_factory=RandomWalk)
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        require_positive_definite("measurement_covariance", np.atleast_2d(self.measurement_covariance))

    def initial(self, measurement: ServoMeasurement) -> FullState:
        """State before the first increment.

        Raises:
            ValueError: As `checked` does, or if `measurement_covariance` has another number of features.
        """
        alignment = self.alignment.initial(measurement)
        self._measurement_covariance(alignment.frame_features.shape[-1])
        mean, row = self.prior.moments(alignment)
        return FullState(alignment, mean, repeated_blocks(row, mean.shape[-2]))

    def step(self, state: FullState, measurement: ServoMeasurement) -> tuple[FullState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        *batch, m, columns = state.jacobian.shape
        x = state.jacobian.reshape(*batch, m * columns)

        predicted = state.covariance.copy()
        diagonal = np.einsum("...ii->...i", predicted)
        diagonal += np.tile(self.walk.deviations(columns - 1, increment.time) ** 2, m)
        H = observation_matrix(interval(increment), m)
        R = self._measurement_covariance(m)
        PH = np.einsum("...ij,...kj->...ik", predicted, H)
        S = np.einsum("...ij,...jk->...ik", H, PH) + R
        innovation = increment.features - np.einsum("...ij,...j->...i", H, x)
        K = np.swapaxes(np.linalg.solve(S, np.swapaxes(PH, -1, -2)), -1, -2)
        keep = np.eye(m * columns) - np.einsum("...ij,...jk->...ik", K, H)
        covariance = np.einsum("...ij,...jk,...lk->...il", keep, predicted, keep) + np.einsum(
            "...ij,jk,...lk->...il", K, R, K
        )
        updated = (
            (x + np.einsum("...ij,...j->...i", K, innovation)).reshape(state.jacobian.shape),
            keep_definite(0.5 * (covariance + np.swapaxes(covariance, -1, -2)), diagonal),
        )
        mean, covariance = select_rows(increment.fresh, updated, (state.jacobian, state.covariance))
        scores = correlated_scores(innovation, S, increment.fresh)
        estimate = present_estimate(alignment.frame_features, mean, increment, measurement.goal, *scores)
        return FullState(alignment, mean, covariance), estimate

    def forget(self, state: FullState) -> FullState:
        """Keep the mean and reset the covariance to the prior's."""
        mean, row = self.prior.moments(state.alignment)
        return state._replace(covariance=repeated_blocks(row, mean.shape[-2]))

    def _measurement_covariance(self, features: int) -> Array:
        given = np.asarray(self.measurement_covariance, dtype=np.float64)
        if given.ndim == 0:
            return given * np.eye(features)
        if given.shape != (features, features):
            raise ValueError(
                f"measurement_covariance must have shape (m, m) = {(features, features)}, got {given.shape}; "
                "give one row per feature or a single variance"
            )
        return given


def repeated_blocks(block: Array, times: int) -> Array:
    """Block-diagonal matrices that repeat one block. Shape (*batch, times d, times d).

    Args:
        block: Block on the diagonal. Shape (*batch, d, d).
        times: Number of repetitions.
    """
    d = block.shape[-1]
    blocks = np.einsum("ab,...ij->...aibj", np.eye(times), block)
    return blocks.reshape(*block.shape[:-2], times * d, times * d)


def observation_matrix(direction: Array, features: int) -> Array:
    """H = blockdiag(ds', ..., ds') (Zhang 2011, after eq. 9). Shape (*batch, m, m (n + 1))."""
    H = np.einsum("ab,...j->...abj", np.eye(features), direction)
    return H.reshape(*direction.shape[:-1], features, features * direction.shape[-1])
