"""Base of the worlds with people: ground truth of the newest frame, scores of the last answer, and tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.resumed import checked_rows, put_scores, scored_state
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.metrics import (
    SetScores,
    Track,
    box_distances,
    mot_scores,
    point_distances,
    stack_tracks,
)
from servotrack.estimators.types import Array, Labels

MIN_VISIBILITY = 0.2
"""Smallest visible share with which a person is scored. People below it are ignored."""


_SCORES = (
    "truncated", "reward", "ospa", "gospa", "location", "missed", "false", "cardinality_error", "ospa2", "mota", "idf1",
    "hota",
)  # fmt: skip


class PeopleWorld:
    """Base of N scenes of people with one observer each. Arrays have a leading axis of N, then n rows of people.

    Args:
        count: Number of scenes N.
        horizon: Number of frames of an episode.
        rows: Rows of an answer.
        boxes: True if answers are boxes, False if they are centers.
        cutoff: Cut-off c of the reward and of all scores.
        scored: True if there is ground truth.

    Attributes:
        images: Newest frames, N arrays of shape (H, W, 3).
        ids: Identity in each row, shape (N, n), from 1; 0 for an unused row.
        boxes: True boxes (left, top, width, height), shape (N, n, 4), px.
        visibility: Visible share of each person, shape (N, n).
        exists: True for scored people, with a visible share of at least `MIN_VISIBILITY`, shape (N, n).
        steps: Number of answered frames, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 without ground truth.
        terminated: Always False, shape (N,).
        truncated: True if all frames are answered, shape (N,), bool.
        ospa, gospa, location, missed, false: Scores of the last answer, shape (N,).
        cardinality_error: Number of reported people minus number of true ones, shape (N,), int.
        ospa2, mota, idf1, hota: Scores of the episode, shape (N,); 0 until `truncated`.
        scorer: Holds identities and reported rows of the last answer.
    """

    images: list[NDArray[np.uint8]]

    def __init__(self, count: int, horizon: int, rows: int, boxes: bool, cutoff: float, scored: bool = True) -> None:
        self.count, self.horizon, self.cutoff, self.scored = count, horizon, cutoff, scored
        self._answers_boxes, self._dimension = boxes, 4 if boxes else 2
        self._distances = box_distances if boxes else point_distances
        self.scorer = SetScorer(count, rows, self._dimension, horizon, cutoff, self._distances)
        self.steps, self.seeds = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)
        self.mota, self.idf1, self.hota = np.zeros(count), np.zeros(count), np.zeros(count)

    def answered_tracks(self, row: int) -> list[Track]:
        """Return the reported tracks of one observer so far, without answers at ignored people."""
        return self.scorer.tracks(row)

    def true_tracks(self, row: int) -> list[Track]:
        """Return the true tracks at the answered frames, one per identity, without frames in which it is ignored.

        Returns:
            Tracks in the order of identities. States are boxes, or centers if answers are centers, px.
        """
        ids, boxes, visibility = self._past(row)
        states, counted = self._answerable(boxes), (visibility >= MIN_VISIBILITY) & (ids > 0)
        tracks = []
        for identity in np.unique(ids[counted]).tolist():
            frames, rows = np.nonzero((ids == identity) & counted)
            tracks.append(Track(frames.astype(np.int64), states[frames, rows]))
        return tracks

    def truth(self) -> dict[str, Any]:
        """Return the entries of `info["truth"]` for the newest frame, arrays of N rows."""
        return {"boxes": self.boxes, "ids": self.ids, "visibility": self.visibility, "exists": self.exists}

    def scores(self) -> dict[str, Any]:
        """Return the entries of `info` for the last answer, arrays of N rows."""
        return {
            "ospa": self.ospa,
            "gospa": self.gospa,
            "location_error": self.location,
            "missed_error": self.missed,
            "false_error": self.false,
            "cardinality_error": self.cardinality_error,
        }

    def episode_scores(self) -> dict[str, Any]:
        """Return the entries of `info` at the end of an episode, arrays of N rows."""
        return {"ospa2": self.ospa2, "mota": self.mota, "idf1": self.idf1, "hota": self.hota}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.horizon

    def privileged(self) -> dict[str, Array]:
        """Return the privileged information of oracle agents, arrays of N rows.

        Returns:
            `true_boxes` (N, n, 4), px; `true_ids` (N, n), 0 for an unused row; `true_existence` (N, n), 1 for scored
            people, else 0; `true_visibility` (N, n). Without ground truth n is 0.
        """
        return {
            "true_boxes": self.boxes.copy(),
            "true_ids": self.ids.astype(np.float64),
            "true_existence": self.exists.astype(np.float64),
            "true_visibility": self.visibility.copy(),
        }

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, the steps, and the scores so far."""
        return scored_state(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Scenes are drawn again from their seeds, frame by frame.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        seeds, steps = checked_rows(self, state, self.horizon)
        self.reset(range(self.count), seeds.tolist())
        for row, answered in enumerate(steps.tolist()):
            for step in range(1, answered + 1):
                self.steps[row] = step
                self._advance(row)
        put_scores(self, _SCORES, state)
        self._newest()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change."""
        raise NotImplementedError

    def _advance(self, row: int) -> None:
        """Show the frame at the row's step, one after the frame that it shows."""
        raise NotImplementedError

    def _newest(self) -> None:
        """Take over the ground truth of the newest frames."""
        raise NotImplementedError

    def _past(self, row: int) -> tuple[Labels, Array, Array]:
        """Return ids (k, n), boxes (k, n, 4) and visibilities (k, n) of the k answered frames of a scene."""
        raise NotImplementedError

    def _begin(self, row: int, seed: int) -> None:
        """Start a new episode."""
        self.scorer.reset(row)
        self.seeds[row], self.steps[row], self.truncated[row] = seed, 0, False
        self.ospa2[row] = self.mota[row] = self.idf1[row] = self.hota[row] = 0.0

    def _note_truth(self, ids: Labels, boxes: Array, visibility: Array) -> None:
        """Store the ground truth of the newest frames."""
        self.ids, self.boxes, self.visibility = ids, boxes, visibility
        self.exists = (ids > 0) & (visibility >= MIN_VISIBILITY)

    def _score(self, answers: Array) -> None:
        """Score the answers to the newest frames."""
        hidden = (self.ids > 0) & ~self.exists
        scores: SetScores = self.scorer.score(answers, self._answerable(self.boxes), self.exists, self.steps, hidden)
        if self.scored:
            self.ospa, self.cardinality_error = scores.ospa, scores.cardinality_error
            self.gospa, self.location, self.missed, self.false = scores.gospa
            self.reward = -scores.gospa.total / self.cutoff

    def _finish(self, row: int) -> None:
        """Compute the scores of a whole episode, if there is ground truth."""
        if not self.scored:
            return
        true, answered = self.true_tracks(row), self.answered_tracks(row)
        self.ospa2[row] = self.scorer.trajectory_score(row, stack_tracks(true, self.horizon, self._dimension))
        if not true and not answered:
            # The metrics are 0 / 0 here. An empty answer to an empty scene has no error.
            self.mota[row] = self.idf1[row] = self.hota[row] = 1.0
            return
        found = mot_scores(true, answered, self._distances, self.cutoff)
        self.mota[row], self.idf1[row], self.hota[row] = found.mota, found.idf1, found.hota

    def _answerable(self, boxes: Array) -> Array:
        """Return the boxes, or their centers if answers are centers."""
        return boxes if self._answers_boxes else boxes[..., :2] + 0.5 * boxes[..., 2:]
