"""What the worlds of people on video share: the truth of the newest frame, scores of the last answer, and tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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

COUNTED_FROM = 0.2
"""Visible share from which a person counts."""


class PeopleWorld:
    """Base of N scenes of people with N observers; arrays carry a leading axis of N, people have n rows.

    Args:
        count: Number of scenes N.
        horizon: Frames of an episode.
        rows: Rows of an answer.
        boxes: Whether answers are boxes; else they are centers.
        cutoff: The c of reward and scores.
        scored: Whether the truth is known.

    Attributes:
        images: The newest frames, N arrays of shape (H, W, 3).
        ids: Who is in a row, shape (N, n): identities from 1, 0 for nobody in the image.
        boxes: Shape (N, n, 4): left, top, width, height, px.
        visibility: Visible share of each, shape (N, n).
        exists: Who counts, shape (N, n): those of whom at least a fifth is visible.
        steps: Frames answered so far, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 where the truth is not known.
        terminated: Never; shape (N,), bool.
        truncated: All frames answered, shape (N,), bool.
        ospa, gospa, location, missed, false: Of the last answer, shape (N,).
        cardinality_error: Reported people minus true ones, shape (N,), int.
        ospa2, mota, idf1, hota: Of the episode, shape (N,); 0 until `truncated`.
        scorer: Identities and reported rows of the last answer.
    """

    images: list[NDArray[np.uint8]]

    def __init__(self, count: int, horizon: int, rows: int, boxes: bool, cutoff: float, scored: bool = True) -> None:
        self.count, self.horizon, self.cutoff, self.scored = count, horizon, cutoff, scored
        self._answers_boxes, self._dimension = boxes, 4 if boxes else 2
        self._distances = box_distances if boxes else point_distances
        self.scorer = SetScorer(count, rows, self._dimension, horizon, cutoff, self._distances)
        self.steps = np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)
        self.mota, self.idf1, self.hota = np.zeros(count), np.zeros(count), np.zeros(count)

    def answered_tracks(self, row: int) -> list[Track]:
        """What one observer has reported so far, without answers at people who do not count."""
        return self.scorer.tracks(row)

    def true_tracks(self, row: int) -> list[Track]:
        """True tracks at the frames answered so far, one per identity, without frames in which it does not count.

        Returns:
            In the order of identities; states are boxes, or centers where answers are centers, px.
        """
        ids, boxes, visibility = self._past(row)
        states, counted = self._answerable(boxes), (visibility >= COUNTED_FROM) & (ids > 0)
        tracks = []
        for identity in np.unique(ids[counted]).tolist():
            frames, rows = np.nonzero((ids == identity) & counted)
            tracks.append(Track(frames.astype(np.int64), states[frames, rows]))
        return tracks

    def truth(self) -> dict[str, Any]:
        """What `info["truth"]` tells of the newest frame, arrays of N rows."""
        return {"boxes": self.boxes, "ids": self.ids, "visibility": self.visibility, "exists": self.exists}

    def scores(self) -> dict[str, Any]:
        """What `info` tells of the last answer, arrays of N rows."""
        return {
            "ospa": self.ospa,
            "gospa": self.gospa,
            "location_error": self.location,
            "missed_error": self.missed,
            "false_error": self.false,
            "cardinality_error": self.cardinality_error,
        }

    def episode_scores(self) -> dict[str, Any]:
        """What `info` tells at an episode's end, arrays of N rows."""
        return {"ospa2": self.ospa2, "mota": self.mota, "idf1": self.idf1, "hota": self.hota}

    def privileged(self) -> dict[str, Array]:
        """What an oracle may know, besides the observation; arrays of N rows.

        Returns:
            `true_boxes` (N, n, 4), px; `true_ids` (N, n), 0 for nobody; `true_existence` (N, n), 0 or 1: who counts;
            `true_visibility` (N, n). n is 0 where the truth is not known.
        """
        return {
            "true_boxes": self.boxes.copy(),
            "true_ids": self.ids.astype(np.float64),
            "true_existence": self.exists.astype(np.float64),
            "true_visibility": self.visibility.copy(),
        }

    def _past(self, row: int) -> tuple[Labels, Array, Array]:
        """Identities (k, n), boxes (k, n, 4) and visibilities (k, n) of one scene's k answered frames."""
        raise NotImplementedError

    def _begin(self, row: int) -> None:
        """A new episode."""
        self.scorer.reset(row)
        self.steps[row], self.truncated[row] = 0, False
        self.ospa2[row] = self.mota[row] = self.idf1[row] = self.hota[row] = 0.0

    def _note_truth(self, ids: Labels, boxes: Array, visibility: Array) -> None:
        """The newest frames' truth."""
        self.ids, self.boxes, self.visibility = ids, boxes, visibility
        self.exists = (ids > 0) & (visibility >= COUNTED_FROM)

    def _score(self, answers: Array) -> None:
        """Score the answers to the newest frames."""
        hidden = (self.ids > 0) & ~self.exists
        scores: SetScores = self.scorer.score(answers, self._answerable(self.boxes), self.exists, self.steps, hidden)
        if self.scored:
            self.ospa, self.cardinality_error = scores.ospa, scores.cardinality_error
            self.gospa, self.location, self.missed, self.false = scores.gospa
            self.reward = -scores.gospa.total / self.cutoff

    def _finish(self, row: int) -> None:
        """Scores of a whole episode, where the truth is known."""
        if not self.scored:
            return
        true, answered = self.true_tracks(row), self.answered_tracks(row)
        self.ospa2[row] = self.scorer.trajectory_score(row, stack_tracks(true, self.horizon, self._dimension))
        if not true and not answered:
            # The metrics are defined by shares of nothing then; who reports nobody where nobody is has made no error.
            self.mota[row] = self.idf1[row] = self.hota[row] = 1.0
            return
        found = mot_scores(true, answered, self._distances, self.cutoff)
        self.mota[row], self.idf1[row], self.hota[row] = found.mota, found.idf1, found.hota

    def _answerable(self, boxes: Array) -> Array:
        """Boxes as they are, or their centers where answers are centers."""
        return boxes if self._answers_boxes else boxes[..., :2] + 0.5 * boxes[..., 2:]
