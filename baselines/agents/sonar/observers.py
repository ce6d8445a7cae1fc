"""Observers of bearings: a tracker behind `predict`, scene by scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.row_reservation import (
    ReservedRows,
    allocate_rows,
    join_scenes,
    no_rows,
    select_scene,
)
from servotrack.baselines.agents.sonar.catalog import BearingTracker, sonar_tracker
from servotrack.baselines.worlds import public_attribute
from servotrack.envs.track.sonar.array_model import SonarModel
from servotrack.estimators.rfs import RowAllocation, SetEstimate
from servotrack.estimators.stateful import add_axis, select_rows
from servotrack.estimators.types import Array, Mask

BEARING = (0,)
"""Entry of a state that holds the bearing."""


class SonarObserverState(NamedTuple):
    """Memory of a `SonarObserver`.

    Attributes:
        beliefs: Tracker state of each of N scenes.
        rows: Owners of the rows of the answers.
    """

    beliefs: tuple[Any, ...]
    rows: ReservedRows


class SonarObserver:
    """A tracker of bearings behind `predict`: records in, sets of bearings out.

    Args:
        tracker: Tracker of `servotrack.estimators.sonar`. Its states begin with the bearing in deg, for the record
            `lag` before the newest.
        low: Lowest answer, shape (rows, 2); answers are clipped to the action space.
        high: Highest answer, shape (rows, 2).
    """

    def __init__(self, tracker: BearingTracker, low: Array, high: Array) -> None:
        self.tracker = tracker
        self._low, self._high = low, high
        self._allocation = RowAllocation(len(low), BEARING)

    def predict(
        self,
        observation: Any,
        state: SonarObserverState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, SonarObserverState]:
        """Answer a record.

        Args:
            observation: Beam powers divided by their noise level, shape (beams,), or (N, beams) for N scenes.
            state: Result of the last call; None starts every scene anew.
            episode_start: Scenes that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the answer is always deterministic.

        Returns:
            The answer, shape (rows, 2) or (N, rows, 2), and the new state.

        Raises:
            ValueError: A record that the tracker refuses.
        """
        records = np.asarray(observation, dtype=np.float64)
        single = records.ndim == 1
        records = records[None] if single else records
        count = len(records)
        starts = np.zeros(count, np.bool_) if episode_start is None else np.broadcast_to(episode_start, (count,))
        fresh = no_rows(self._allocation, count, 1)
        if state is None:
            state, starts = SonarObserverState((None,) * count, fresh), np.ones(count, np.bool_)
        rows = select_rows(starts, fresh, state.rows)
        beliefs, memories, answers = [], [], []
        for k, record in enumerate(records):
            belief = self.tracker.initial(record) if starts[k] else state.beliefs[k]
            belief, estimate = self.tracker.step(belief, record)
            memory, answer = allocate_rows(self._allocation, select_scene(rows, k), _of_one(estimate))
            beliefs.append(belief)
            memories.append(memory)
            answers.append(answer)
        joined = np.clip(np.concatenate(answers), self._low, self._high)
        return (joined[0] if single else joined), SonarObserverState(tuple(beliefs), join_scenes(memories))


class BearingOracle:
    """Reports the true bearings, target i in row i; privileged, without memory.

    Args:
        rows: Number of rows of an answer.
    """

    def __init__(self, rows: int) -> None:
        self._rows = rows

    def predict(
        self,
        observation: Mapping[str, Array],
        state: Any = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Answer a record; arguments as in `SonarObserver.predict`, with the truth in the observation."""
        exists, bearings = np.asarray(observation["true_existence"]), np.asarray(observation["true_bearings"])
        answer = np.zeros((*exists.shape[:-1], self._rows, 2))
        kept = min(exists.shape[-1], self._rows)
        answer[..., :kept, 0], answer[..., :kept, 1] = exists[..., :kept], bearings[..., :kept]
        return answer, None


def create_sonar_observer(
    env: Any, tracker: str, values: Mapping[str, float] | None = None
) -> SonarObserver | BearingOracle:
    """Create an observer of bearings; only the environment's spaces and its `scene_model` are read.

    Args:
        env: An environment or vector environment whose `scene_model` is a `SonarModel`.
        tracker: A name of `agents.sonar.catalog.TRACKERS`, or "bearing-oracle".
        values: Numbers of the tracker that differ from its defaults, by path; see `with_values`.

    Raises:
        ValueError: An environment without a `SonarModel`, an unknown tracker, or values that do not fit it.
    """
    scene = public_attribute(env, "scene_model")
    if not isinstance(scene, SonarModel):
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"agent {tracker!r} needs an environment whose `unwrapped.scene_model` is a SonarModel; {name} has none: "
            "choose SonarTracking-v0, or another agent"
        )
    space = getattr(env, "single_action_space", env.action_space)
    if tracker == "bearing-oracle":
        return BearingOracle(space.shape[0])
    return SonarObserver(with_values(sonar_tracker(tracker, scene), values or {}), space.low, space.high)


def _of_one(estimate: SetEstimate) -> SetEstimate:
    """Return the bearings of an estimate, with a leading axis of one scene."""
    values = {name: np.asarray(getattr(estimate, name)) for name in SetEstimate.__dataclass_fields__}
    values |= {name: values[name][:, :1] for name in ("states", "held_states")}
    values["covariances"] = values["covariances"][:, :1, :1]
    return SetEstimate(**{name: add_axis(value) for name, value in values.items()})
