"""Agents of the tracking worlds: a set estimator behind `predict`, which answers every scan with a fixed array."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.clutter.association_oracle import AssociationOracle
from servotrack.baselines.agents.clutter.catalog import observer_settings, track_filter
from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.row_patience import ReservedRows, allocate_rows, no_rows
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.envs.track.people.camera_model import VideoModel
from servotrack.envs.wrappers import OBSERVATION_KEY
from servotrack.estimators.rfs import RowAllocation
from servotrack.estimators.types import Array, Mask

POSITION = (0, 2)
"""Where a state [x, vx, y, vy] holds the position."""


class ObserverState(NamedTuple):
    """Memory of a `SetObserver`; everything has a leading axis of scenes.

    Attributes:
        belief: The estimator's state.
        rows: Which identity owns which row of the answer.
    """

    belief: Any
    rows: ReservedRows


class SetObserver:
    """A set estimator behind `predict`: scans in, sets with identities out.

    Args:
        estimator: As in `servotrack.estimators.rfs`.
        rows: Rows of an answer.
        low: Lowest answer, shape (rows, 3); answers are clipped to the action space.
        high: Highest answer, shape (rows, 3).
    """

    def __init__(self, estimator: Any, rows: int, low: Array, high: Array) -> None:
        self.estimator = estimator
        self._allocation = RowAllocation(rows, POSITION)
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
            observation: Shape (M, 1 + m), or (N, M, 1 + m) for N scenes; or a dictionary with that under
                `observation` and the truth beside it.
            state: What the last call returned; None starts anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: These agents always are.

        Returns:
            Shape (rows, 3) or (N, rows, 3); and the new state.

        Raises:
            ValueError: As the estimator does.
        """
        scan, single = _batched(observation)
        count = len(scan[OBSERVATION_KEY])
        measurement = scan if len(scan) > 1 else scan[OBSERVATION_KEY]
        state = remembered(state, episode_start, (count,), lambda: self._initial(measurement, count))
        belief, estimate = self.estimator.step(state.belief, measurement)
        rows, answer = allocate_rows(self._allocation, state.rows, estimate)
        answer = np.clip(answer, self._low, self._high)
        return (answer[0] if single else answer), ObserverState(belief, rows)

    def _initial(self, measurement: Any, count: int) -> ObserverState:
        return ObserverState(self.estimator.initial(measurement), no_rows(self._allocation, count, self._state_size))


class RawObserver:
    """Reports every measurement, in the row it came in: no memory, no identities.

    Args:
        estimator: A `RawMeasurements`, for where measurements lie in the plane.
        low: Lowest answer, shape (rows, 3).
        high: Highest answer, shape (rows, 3).
    """

    def __init__(self, estimator: Any, low: Array, high: Array) -> None:
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
        scan, single = _batched(observation)
        measurement = scan[OBSERVATION_KEY]
        _, estimate = self.estimator.step(self.estimator.initial(measurement), measurement)
        answer = np.zeros((len(measurement), *self._low.shape))
        kept = min(estimate.states.shape[1], answer.shape[1])
        answer[:, :kept, 0] = estimate.existence[:, :kept]
        answer[:, :kept, 1:] = estimate.states[:, :kept][..., list(POSITION)]
        answer = np.clip(answer, self._low, self._high)
        return (answer[0] if single else answer), None


def create_observer(env: Any, estimator: str, hidden_markov: bool = False, extraction: str = "threshold") -> Any:
    """An observer for a tracking world, of which only the spaces and what it tells its agents (`told`) are read.

    Args:
        env: A tracking environment or vector environment.
        estimator: A name from `agents.clutter.catalog`, or "association-oracle"; in worlds of people on
            video as `create_video_observer` takes it.
        hidden_markov: Ignore the dependence of the noises.
        extraction: "threshold", "sum" or "map".

    Raises:
        ValueError: The environment is no tracking world.
    """
    scene = getattr(env.unwrapped, "scene_model", None)
    if isinstance(scene, VideoModel):
        from servotrack.baselines.agents.people.observers import create_video_observer

        return create_video_observer(env, estimator)
    space = getattr(env, "single_action_space", env.action_space)
    if not isinstance(scene, SceneModel):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {estimator!r} needs a tracking world that tells its agents a model (`told`) of points in clutter; "
            f"{name} does not: choose ClutterTracking-v0, or another agent"
        )
    rows = space.shape[0]
    if estimator == "association-oracle":
        return SetObserver(AssociationOracle(scene.model, scene.birth_covariance), rows, space.low, space.high)
    settings = replace(observer_settings(rows), hidden_markov=hidden_markov, extraction=extraction)
    made = track_filter(estimator, scene, settings)
    if estimator == "raw-measurements":
        return RawObserver(made, space.low, space.high)
    return SetObserver(made, rows, space.low, space.high)


def _batched(observation: Any) -> tuple[dict[str, Array], bool]:
    """An observation as a dictionary of arrays with a leading axis of scenes, and whether it came without one."""
    parts = dict(observation) if isinstance(observation, Mapping) else {OBSERVATION_KEY: observation}
    single = np.ndim(parts[OBSERVATION_KEY]) == 2
    arrays = {key: np.asarray(value, dtype=np.float64) for key, value in parts.items()}
    return ({key: value[None] for key, value in arrays.items()} if single else arrays), single
