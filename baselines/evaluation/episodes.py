"""Rows of results, one per episode: return, length, and the scores of the kind of world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.worlds import WORLDS, kind_of
from servotrack.estimators.types import Mask


class ScoreRecorder(Protocol):
    """Score recorder of one kind of world, made with (rows, observation, max_steps)."""

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add one step of the vector environment; `ending` marks the rows whose episode ends with it, shape (N,)."""

    def columns(self, row: int, length: int) -> Row:
        """Columns of one finished episode of `length` steps."""


class EpisodeRecorder:
    """Collects the first episode of every row of a vector environment.

    Args:
        seeds: Seeds, one per row.
        env: The vector environment. Its kind decides which scores are recorded.
        observation: First observation, from `reset`.

    Raises:
        ValueError: An unknown kind, or a servo environment too short to have a steady part.
    """

    def __init__(self, seeds: Sequence[int], env: Any, observation: Any) -> None:
        self._seeds = list(seeds)
        rows = len(self._seeds)
        self.max_steps = full_episode_steps(env)
        self.ended: Mask = np.zeros(rows, dtype=bool)
        self._alive: Mask = np.ones(rows, dtype=bool)
        self._returns = np.zeros(rows)
        self._lengths = np.zeros(rows, dtype=np.int64)
        self._successes: list[bool | None] = [None] * rows
        make = WORLDS[kind_of(env)].load_recorder()
        self._scores: ScoreRecorder | None = None if make is None else make(rows, observation, self.max_steps)

    @property
    def finished(self) -> bool:
        """True when every row's episode has ended."""
        return not self._alive.any()

    def record(self, observation: Any, reward: Any, ended: Mask, info: Mapping[str, Any]) -> None:
        """Add one step of the vector environment; rows whose episode ended earlier are ignored."""
        self.ended = np.array(ended, dtype=bool)
        ending = self._alive & self.ended
        self._returns[self._alive] += np.asarray(reward, dtype=np.float64)[self._alive]
        self._lengths += self._alive
        if self._scores is not None:
            self._scores.record(observation, info, ending)
        else:
            for row in np.flatnonzero(ending):
                self._successes[row] = _final_success(info, int(row))
        self._alive &= ~self.ended

    def rows(self) -> list[Row]:
        """One row per seed, in their order."""
        rows = []
        for i, seed in enumerate(self._seeds):
            row: Row = {"seed": seed, "return": float(self._returns[i]), "length": int(self._lengths[i])}
            if self._scores is not None:
                row |= self._scores.columns(i, row["length"])
            elif self._successes[i] is not None:
                row["success"] = self._successes[i]
            rows.append(row)
        return rows


def _final_success(info: Mapping[str, Any], row: int) -> bool | None:
    for key in ("success", "is_success"):
        if key in info and np.asarray(info.get(f"_{key}", True)).reshape(-1)[row if f"_{key}" in info else 0]:
            return bool(np.asarray(info[key])[row])
    return None


def full_episode_steps(env: Any) -> int | None:
    """Return the steps of a full episode: those that the environment says, or those of its registration."""
    if (declared := getattr(env.unwrapped, "episode_steps", None)) is not None:
        return int(declared)
    own = None if env.spec is None else env.spec.max_episode_steps
    return None if own is None else int(own)
