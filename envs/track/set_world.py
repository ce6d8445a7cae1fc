"""N scenes whose targets do not depend on the answers, with the scores of the answers to them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.resumed import draw_again, scored_state
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.types import Array, Labels, Mask

_SCORES = (
    "truncated", "scored", "reward", "ospa", "gospa", "location", "missed", "false", "cardinality_error", "ospa2",
)  # fmt: skip


class SetWorld(ABC):
    """N scenes of points with one observer each, stepped together. Arrays have a leading axis of N.

    The observer gets scan k and answers with its estimate of the set of targets at scan k - lag. `step` scores the
    answer and advances to scan k + 1. After `reset` and `step` the attributes describe the newest scan; copy them to
    keep them.

    Args:
        count: Number of scenes N.
        horizon: Scored scans of an episode.
        lag: Delay of the answers, scans.
        rows: Rows of an answer.
        dimensions: Number of coordinates d of a position.
        cutoff: Cut-off c of the scores, m.

    Attributes:
        steps: Number of answered scans, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 if it was not scored.
        terminated: Always False, shape (N,).
        truncated: True if all scans are answered, shape (N,), bool.
        scored: True if the last answer was for a scored scan, shape (N,), bool.
        ospa, gospa, location, missed, false: Scores of the last answer, shape (N,), m; 0 if it was not scored.
        cardinality_error: Number of reported targets minus number of true ones, shape (N,), int; 0 if not scored.
        ospa2: OSPA(2) of the episode, shape (N,), m; 0 until `truncated`.
        scorer: Holds identities and reported rows of the last answer.
    """

    def __init__(self, count: int, horizon: int, lag: int, rows: int, dimensions: int, cutoff: float) -> None:
        self.count, self.horizon, self.lag, self.cutoff = count, horizon, lag, cutoff
        self.scorer = SetScorer(count, rows, dimensions, horizon, cutoff)
        self.steps, self.seeds = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.scored = np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)

    @abstractmethod
    def _begin(self, row: int, seed: int) -> None:
        """Draw the episode of a row."""

    @abstractmethod
    def _observe(self) -> None:
        """Set the attributes that describe the newest scans."""

    @abstractmethod
    def _truth_at(self, steps: Labels) -> tuple[Array, Mask]:
        """Return true positions (N, n, d), m, and existence (N, n) of one scan of each row."""

    @abstractmethod
    def true_tracks(self, row: int) -> Array:
        """Return the true positions at the scored scans, shape (n, horizon, d), m; NaN if a target is absent."""

    def _is_scored(self, at: Labels) -> Mask:
        """Return which scans are scored, shape (N,)."""
        return (at >= 0) & (at < self.horizon)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change.

        Args:
            rows: Indices of the scenes.
            seeds: Episode seed of each, non-negative integers.
        """
        for row, seed in zip(rows, seeds, strict=True):
            self._begin(row, seed)
            self.scorer.reset(row)
            self.seeds[row], self.steps[row], self.truncated[row], self.ospa2[row] = seed, 0, False, 0.0
        self._observe()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers to the newest scans, and advance to the next scans.

        Args:
            answers: Existence and position (m) at scan `steps` - lag, shape (N, rows, 1 + d).
            running: True for scenes whose episode is running, shape (N,), bool; None: all. The other scenes stay at
                their scan until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        at = self.steps - self.lag
        self.scored = self._is_scored(at)
        positions, exists = self._truth_at(np.where(self.scored, at, 0))
        # An answer for a time before the first scan only starts identities.
        scores = self.scorer.score(answers, positions, exists, np.where(self.scored, at, self.horizon))
        self.ospa = np.where(self.scored, scores.ospa, 0.0)
        self.cardinality_error = np.where(self.scored, scores.cardinality_error, 0)
        self.gospa, self.location, self.missed, self.false = (np.where(self.scored, v, 0.0) for v in scores.gospa)
        self.reward = np.where(self.scored, -self.gospa / self.cutoff, 0.0)
        self.steps = self.steps + running
        self.truncated = self.steps >= self.episode_steps
        for row in np.flatnonzero(running & self.truncated).tolist():
            self.ospa2[row] = self.scorer.trajectory_score(row, self.true_tracks(row))
        self._observe()

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, the steps, and the scores so far."""
        return scored_state(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Scenes are drawn again from their seeds.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        draw_again(self, _SCORES, state, self.episode_steps)
        self._observe()

    def scores(self) -> dict[str, Any]:
        """Return the entries of `info` for the last answer, arrays of N rows."""
        return {
            "scored": self.scored,
            "ospa": self.ospa,
            "gospa": self.gospa,
            "location_error": self.location,
            "missed_error": self.missed,
            "false_error": self.false,
            "cardinality_error": self.cardinality_error,
        }

    def episode_scores(self) -> dict[str, Any]:
        """Return the entries of `info` at the end of an episode, arrays of N rows."""
        return {"ospa2": self.ospa2}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.horizon + self.lag
