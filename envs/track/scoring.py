"""Scores of set-valued answers: identities out of rows, the reward, and OSPA(2) at an episode's end."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from servotrack.envs.track.ignored import ignored_answers
from servotrack.estimators.metrics import (
    SetScores,
    Track,
    ospa2,
    point_distances,
    score_distances,
    stack_tracks,
    tracks_from_rows,
)
from servotrack.estimators.types import Array, Labels, Mask

REPORTED_FROM = 0.5
"""Existence from which a row is reported."""
HELD_FROM = 0.05
"""Existence from which a row keeps its identity without being reported; below it the identity ends."""


class SetScorer:
    """Scores of N observers, step by step; a row of an answer is an identity.

    Args:
        count: Number of observers N.
        rows: Rows of an answer.
        dimension: Numbers of a state d.
        horizon: Steps of an episode.
        cutoff: The c of OSPA, GOSPA and OSPA(2).
        distances: Base distances of two arrays of states, (N, n, d) and (N, k, d) to (N, n, k).

    Attributes:
        labels: Identity of each row, shape (N, rows), -1 where the row holds none.
        reported: Which rows are reported, shape (N, rows).
        estimates: States in the rows, shape (N, rows, d).
    """

    def __init__(
        self,
        count: int,
        rows: int,
        dimension: int,
        horizon: int,
        cutoff: float,
        distances: Callable[[Array, Array], Array] = point_distances,
    ) -> None:
        self._cutoff, self._distances = cutoff, distances
        self.labels = np.full((count, rows), -1, dtype=np.int64)
        self.reported = np.zeros((count, rows), np.bool_)
        self.estimates = np.zeros((count, rows, dimension))
        self._next = np.zeros(count, np.int64)
        self._label_history = np.full((count, horizon, rows), -1, dtype=np.int64)
        self._state_history = np.zeros((count, horizon, rows, dimension))

    def reset(self, row: int) -> None:
        """Forget one observer's episode."""
        self.labels[row], self.reported[row], self.estimates[row] = -1, False, 0.0
        self._next[row] = 0
        self._label_history[row] = -1

    def score(
        self,
        answers: Array,
        truth: Array,
        truth_exists: Mask,
        steps: Sequence[int] | Labels,
        hidden: Mask | None = None,
    ) -> SetScores:
        """Take one step's answers in.

        Args:
            answers: Shape (N, rows, 1 + d), existence first.
            truth: Shape (N, n, d).
            truth_exists: Shape (N, n).
            steps: The step of each observer's episode that its answer is for, shape (N,); one beyond the horizon is
                scored, but not remembered.
            hidden: Members of the truth that are there but do not count, shape (N, n), none of them in `truth_exists`:
                nobody misses them, and an answer at theirs is left out of all scores; see `ignored_answers`.
        """
        existence = answers[..., 0]
        self.labels = _labeled(existence, self.labels, self._next)
        self.reported = existence >= REPORTED_FROM
        self.estimates = answers[..., 1:].copy()
        distances = self._distances(truth, self.estimates)
        scored = self.reported
        if hidden is not None and hidden.any():
            scored = scored & ~ignored_answers(distances, truth_exists, hidden, scored, self._cutoff)
        inside = np.flatnonzero(np.asarray(steps) < self._label_history.shape[1])
        at = np.asarray(steps)[inside]
        self._label_history[inside, at] = np.where(scored, self.labels, -1)[inside]
        self._state_history[inside, at] = self.estimates[inside]
        return score_distances(distances, truth_exists, scored, self._cutoff)

    def tracks(self, row: int) -> list[Track]:
        """What one observer has reported so far, one track per identity, without the answers that do not count."""
        return tracks_from_rows(self._label_history[row], self._state_history[row])

    def trajectory_score(self, row: int, truth: Array) -> float:
        """OSPA(2) of one observer's whole episode.

        Args:
            row: Which of the N.
            truth: True tracks, shape (n, horizon, d), NaN where a target does not exist.
        """
        tracks = stack_tracks(self.tracks(row), truth.shape[1], truth.shape[2])
        if self._distances is point_distances:
            return ospa2(truth, tracks, self._cutoff)
        return ospa2(truth, tracks, self._cutoff, distances=self._distances)


@njit(cache=True, nogil=True)
def _labeled(existence, labels, following):  # type: ignore[no-untyped-def]
    """Identities after an answer, shape (N, rows): a row that was empty gets `following`, which is counted up."""
    out = np.full(labels.shape, -1, np.int64)
    for row in range(len(labels)):
        for k in range(labels.shape[1]):
            if existence[row, k] < HELD_FROM:
                continue
            out[row, k] = labels[row, k]
            if labels[row, k] < 0:
                out[row, k] = following[row]
                following[row] += 1
    return out
