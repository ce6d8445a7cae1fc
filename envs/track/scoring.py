"""Scores of set-valued answers: identities from rows, OSPA and GOSPA per step, OSPA(2) at the end of an episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State, put, taken
from servotrack.envs.track.ignored import ignored_answers
from servotrack.estimators.compilation import njit
from servotrack.estimators.metrics import (
    SetScores,
    Track,
    ospa2,
    point_distances,
    score_distances,
    tracks_from_rows,
)
from servotrack.estimators.types import Array, Labels, Mask

REPORTED_FROM = 0.5
"""Smallest existence with which a row is reported."""
HELD_FROM = 0.05
"""Smallest existence with which a row keeps its identity. Below it the identity ends."""


_KEPT = ("labels", "reported", "estimates", "_next", "_label_history", "_state_history")


class SetScorer:
    """Scores of N observers, step by step. A row of an answer is an identity.

    Args:
        count: Number of observers N.
        rows: Number of rows of an answer.
        dimension: Dimension d of a state.
        horizon: Number of steps of an episode.
        cutoff: Cut-off c of OSPA, GOSPA and OSPA(2).
        distances: Function that maps two arrays of states, (N, n, d) and (N, k, d), to base distances (N, n, k).

    Attributes:
        labels: Identity of each row, shape (N, rows); -1 for an unused row.
        reported: Rows that are reported, shape (N, rows).
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
        """Clear the episode of one observer."""
        self.labels[row], self.reported[row], self.estimates[row] = -1, False, 0.0
        self._next[row] = 0
        self._label_history[row] = -1

    def get_state(self) -> State:
        """Return what `set_state` needs: identities, the last answers and their history."""
        return taken(self, _KEPT)

    def set_state(self, state: Mapping[str, NDArray[Any]], steps: Labels) -> None:
        """Go back to a state in which observers have answered some steps, shape (N,).

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        put(self, _KEPT, state)
        # An observer that waits for its reset is scored once more.
        most = self.labels.shape[1] * (steps + 1)
        for labels in (self.labels[:, None], self._label_history):
            if (labels < -1).any() or (labels >= self._next[:, None, None]).any() or (self._next > most).any():
                raise ValueError("state's labels must lie in -1 to those of identities that have begun")
            ordered = np.sort(labels, axis=-1)
            if ((ordered[..., 1:] == ordered[..., :-1]) & (ordered[..., 1:] >= 0)).any():
                raise ValueError("state's labels must be unique in every step")

    def score(
        self,
        answers: Array,
        truth: Array,
        truth_exists: Mask,
        steps: Sequence[int] | Labels,
        hidden: Mask | None = None,
    ) -> SetScores:
        """Score the answers of one step.

        Args:
            answers: Answers, shape (N, rows, 1 + d), existence in column 0.
            truth: True states, shape (N, n, d).
            truth_exists: True targets that are scored, shape (N, n).
            steps: Step of each observer's episode, shape (N,). A step beyond the horizon is scored, but not stored for
                OSPA(2).
            hidden: True targets that are present but ignored, shape (N, n), disjoint from `truth_exists`. They do not
                count as missed, and an answer at their place is left out of all scores; see `ignored_answers`.
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
        """Return the reported tracks of one observer, one per identity, without ignored answers."""
        return tracks_from_rows(self._label_history[row], self._state_history[row])

    def trajectory_score(self, row: int, truth: Array) -> float:
        """Return OSPA(2) of the whole episode of one observer.

        Args:
            row: Index of the observer.
            truth: True tracks, shape (n, horizon, d); NaN while a target does not exist.
        """
        tracks = _stacked(self._label_history[row], self._state_history[row], self._next[row])
        if self._distances is point_distances:
            return ospa2(truth, tracks, self._cutoff)
        return ospa2(truth, tracks, self._cutoff, distances=self._distances)


@njit(cache=True, nogil=True)
def _labeled(existence, labels, following):  # type: ignore[no-untyped-def]
    """Return the identities after an answer, shape (N, rows). New ones are numbered from `following` on."""
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


@njit(cache=True, nogil=True)
def _stacked(labels, states, count):  # type: ignore[no-untyped-def]
    """Return the tracks of labels 0 to `count` - 1, (k, T, d), NaN where absent, in the order of first appearance.

    Args:
        labels: Label in each row at each step, negative for an empty row, (T, rows).
        states: State in each row at each step, (T, rows, d).
        count: Number of labels, of which some may not occur.
    """
    place, found = np.full(count, -1), 0
    for step in range(labels.shape[0]):
        for label in labels[step]:
            if label >= 0 and place[label] < 0:
                place[label] = found
                found += 1
    out = np.full((found, labels.shape[0], states.shape[2]), np.nan)
    for step in range(labels.shape[0]):
        for row, label in enumerate(labels[step]):
            if label >= 0:
                for axis in range(states.shape[2]):
                    out[place[label], step, axis] = states[step, row, axis]
    return out
