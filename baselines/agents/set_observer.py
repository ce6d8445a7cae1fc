"""Set estimators behind `predict`: scans of points in, fixed arrays of targets with identities out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.row_reservation import ReservedRows, allocate_rows, no_rows
from servotrack.envs.wrappers import INTERVAL_KEY, NOISE_KEY, OBSERVATION_KEY
from servotrack.estimators.rfs import GlobalNearestNeighbor, RawMeasurements, RowAllocation, SetEstimate
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.recursion import GaussianSetFilter
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Mask

POSITION = (0, 2)
"""Entries of a state [x, vx, y, vy] that hold the position."""


def position_entries(dimensions: int) -> tuple[int, ...]:
    """Return the entries of a state [x, vx, y, vy, ...] that hold the position."""
    return tuple(range(0, 2 * dimensions, 2))


class SetEstimator(Protocol):
    """Estimator of `servotrack.estimators.rfs`: batches of scans in, sets of targets out."""

    @property
    def model(self) -> TargetModel:
        """Motion and measurement of one target."""

    def initial(self, measurement: Any, /) -> Any:
        """Return the state before the first scan."""

    def step(self, state: Any, measurement: Any, dt: float | None = None, /) -> tuple[Any, SetEstimate]:
        """Update the state with a scan that follows the last one after `dt` seconds; None: the model's period."""


class ObserverState(NamedTuple):
    """Memory of a `SetObserver`; all arrays have a leading axis of scenes.

    Attributes:
        belief: State of the estimator.
        rows: Owners of the rows of the answer.
    """

    belief: Any
    rows: ReservedRows


class SetObserver:
    """A set estimator behind `predict`: scans in, sets with identities out.

    Args:
        estimator: A filter of `servotrack.estimators.rfs`.
        rows: Number of rows of an answer.
        low: Lowest answer, shape (rows, 1 + d); answers are clipped to the action space.
        high: Highest answer, shape (rows, 1 + d).
    """

    def __init__(self, estimator: SetEstimator, rows: int, low: Array, high: Array) -> None:
        self.estimator = estimator
        self._allocation = RowAllocation(rows, position_entries(low.shape[1] - 1))
        self._low, self._high = low, high
        self._state_size = estimator.model.packed.observation.shape[1]

    def predict(
        self,
        observation: Any,
        state: ObserverState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, ObserverState]:
        """Answer a scan.

        Args:
            observation: Scan of shape (M, 1 + m), or (N, M, 1 + m) for N scenes; or a dictionary with that under
                `observation` and beside it the truth, or under `interval` the time since the scan before, s, (1,) or
                (N, 1), and under `noise` the covariances of the measurements' noise, (M, m, m) or (N, M, m, m).
            state: Result of the last call; None starts every scene anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the answer is always deterministic.

        Returns:
            The answer, shape (rows, 1 + d) or (N, rows, 1 + d), and the new state.

        Raises:
            ValueError: A scan that the estimator refuses.
        """
        scan, single = batched_scan(observation)
        count = len(scan[OBSERVATION_KEY])
        intervals = scan.pop(INTERVAL_KEY, None)
        noise = scan.pop(NOISE_KEY, None)
        measurement = scan if len(scan) > 1 else scan[OBSERVATION_KEY]
        state = remembered(state, episode_start, (count,), lambda: self._initial(measurement, count))
        if intervals is None:
            following, answer = self._stepped(state, measurement, None, noise)
        else:
            # Scenes whose scans follow after the same time are stepped together.
            dt, *others = np.unique(intervals).tolist()
            following, answer = self._stepped(state, measurement, dt, noise)
            for dt in others:
                following, answer = select_rows(
                    intervals[:, 0] == dt, self._stepped(state, measurement, dt, noise), (following, answer)
                )
        answer = np.clip(answer, self._low, self._high)
        return (answer[0] if single else answer), following

    def _stepped(
        self, state: ObserverState, measurement: Any, dt: float | None, noise: Array | None
    ) -> tuple[ObserverState, Array]:
        if noise is not None and isinstance(self.estimator, (GaussianSetFilter, GlobalNearestNeighbor)):
            belief, estimate = self.estimator.step(state.belief, measurement, dt, noise=noise)
        else:
            # Particles and oracles take the mean noise, that of their model.
            belief, estimate = self.estimator.step(state.belief, measurement, dt)
        rows, answer = allocate_rows(self._allocation, state.rows, estimate)
        return ObserverState(belief, rows), answer

    def _initial(self, measurement: Any, count: int) -> ObserverState:
        return ObserverState(self.estimator.initial(measurement), no_rows(self._allocation, count, self._state_size))


class RawObserver:
    """Reports every measurement, in the row it came in: no memory, no identities.

    Args:
        estimator: Converts measurements to positions in the plane.
        low: Lowest answer, shape (rows, 1 + d).
        high: Highest answer, shape (rows, 1 + d).
    """

    def __init__(self, estimator: RawMeasurements, low: Array, high: Array) -> None:
        self.estimator = estimator
        self._low, self._high = low, high

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Answer a scan; arguments as in `SetObserver.predict`. Measurements beyond the answer's rows are left out."""
        scan, single = batched_scan(observation)
        measurement = scan[OBSERVATION_KEY]
        _, estimate = self.estimator.step(self.estimator.initial(measurement), measurement)
        answer = np.zeros((len(measurement), *self._low.shape))
        kept = min(estimate.states.shape[1], answer.shape[1])
        answer[:, :kept, 0] = estimate.existence[:, :kept]
        answer[:, :kept, 1:] = estimate.states[:, :kept][..., list(position_entries(answer.shape[2] - 1))]
        answer = np.clip(answer, self._low, self._high)
        return (answer[0] if single else answer), None


def batched_scan(observation: Any) -> tuple[dict[str, Array], bool]:
    """Return an observation as a dictionary of arrays with a leading axis of scenes.

    Args:
        observation: Observation, as in `SetObserver.predict`.

    Returns:
        The arrays, and True if the observation came without that axis.
    """
    parts = dict(observation) if isinstance(observation, Mapping) else {OBSERVATION_KEY: observation}
    single = np.ndim(parts[OBSERVATION_KEY]) == 2
    arrays = {key: np.asarray(value, dtype=np.float64) for key, value in parts.items()}
    return ({key: value[None] for key, value in arrays.items()} if single else arrays), single
