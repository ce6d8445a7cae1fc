"""N observers of one recorded sequence: the one piece of bookkeeping behind the single and the vector environment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.decoders import Frame
from servotrack.envs.track.pedestrians.config import COUNTED_FROM
from servotrack.envs.track.recorded import SequenceError
from servotrack.envs.track.recording import Recording, VideoConfig, load_recording
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.metrics import Track, box_distances, mot_scores, stack_tracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class VideoWorld:
    """N observers of a sequence, each at a frame of its own; arrays carry a leading axis of N.

    An observer sees frame k and answers with the people it believes in at k; `step` scores that answer and shows frame
    k + 1, after the last frame that one again. Frames are decoded when they are needed, and none is kept.

    Args:
        config: The world's parameters.
        count: Number of observers N.
        pictures: Whether `images` are wanted where detections are observed.

    Attributes:
        recording: The sequence.
        observations: What agents see: frames (N, H, W, 3) uint8, or sets of detections (N, m, 5).
        images: The newest frames, N arrays of shape (H, W, 3).
        ids: Who is in a row, shape (N, n): identities from 1, 0 for nobody.
        boxes: Shape (N, n, 4): left, top, width, height, px.
        visibility: Visible share of each, shape (N, n).
        exists: Who counts, shape (N, n): those of whom at least a fifth is visible.
        steps: Frames answered so far, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 without truth.
        terminated: Never; shape (N,), bool.
        truncated: All frames answered, shape (N,), bool.
        ospa, gospa, location, missed, false: Of the last answer, shape (N,); they and what follows mean nothing without
            truth.
        cardinality_error: Reported people minus true ones, shape (N,), int.
        ospa2, mota, idf1, hota: Of the episode, shape (N,); 0 until `truncated`.
        scorer: Identities and reported rows of the last answer.

    Raises:
        SequenceError: A source or file that cannot be used.
    """

    def __init__(self, config: VideoConfig, count: int, pictures: bool = False) -> None:
        self.config, self.count = config, count
        self.recording: Recording = load_recording(config)
        recording = self.recording
        blank = np.full((recording.height, recording.width, 3), 74, np.uint8)
        self.images: list[Frame] = [blank] * count
        self._decodes = recording.open is not None and (pictures or recording.detections is None)
        self._frames: list[Iterator[Frame]] = [iter(()) for _ in range(count)]
        if recording.detections is None:
            self.observations: NDArray[Any] = np.zeros((count, *blank.shape), np.uint8)
        else:
            self.observations = np.zeros((count, *recording.detections.shape[1:]))
        self.scorer = SetScorer(
            count, config.max_estimates, 4, recording.horizon, config.cutoff, distances=box_distances
        )
        self.steps = np.zeros(count, np.int64)
        self._ended = np.zeros(count, np.bool_)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)
        self.mota, self.idf1, self.hota = np.zeros(count), np.zeros(count), np.zeros(count)
        self._newest()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start again at the first frame in some rows; the others are left as they are, to the bit.

        Args:
            rows: Which of the N.
            seeds: One for each; nothing depends on them.

        Raises:
            SequenceError: The first frame cannot be decoded.
        """
        for row, _ in zip(rows, seeds, strict=True):
            self.scorer.reset(row)
            self.steps[row], self.truncated[row], self._ended[row] = 0, False, False
            self.ospa2[row] = self.mota[row] = self.idf1[row] = self.hota[row] = 0.0
            if self._decodes:
                assert self.recording.open is not None
                self._frames[row] = self.recording.open()
                self.images[row] = next(self._frames[row])
            self._observe(row)
        self._newest()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score every row's answer to its newest frame, and show the next frame.

        Args:
            answers: Shape (N, rows, 5): existence, then boxes, px.
            running: Which of the N have an episode under way, (N,) bool; None for all. The others wait for their reset
                at the frame they are at.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        hidden = (self.ids > 0) & ~self.exists
        scores = self.scorer.score(answers, self.boxes, self.exists, self.steps, hidden)
        if self.recording.scored:
            self.ospa, self.cardinality_error = scores.ospa, scores.cardinality_error
            self.gospa, self.location, self.missed, self.false = scores.gospa
            self.reward = -scores.gospa.total / self.config.cutoff
        self.steps = self.steps + running
        for row in np.flatnonzero(running).tolist():
            if self.steps[row] < self.recording.horizon:
                self._decode(row)
        self.truncated = (self.steps >= self.recording.horizon) | self._ended
        for row in np.flatnonzero(running).tolist():
            self._observe(row)
            if self.truncated[row] and self.recording.scored:
                self._finish(row)
        self._newest()

    def close(self) -> None:
        """Let go of files and cameras."""
        self._frames = [iter(()) for _ in range(self.count)]

    def true_tracks(self, row: int) -> list[Track]:
        """True tracks at the frames answered so far, one per identity, without frames in which it does not count."""
        recording, steps = self.recording, int(self.steps[row])
        ids = recording.ids[:steps]
        counted = (recording.visibility[:steps] >= COUNTED_FROM) & (ids > 0)
        tracks = []
        for identity in np.unique(ids[counted]).tolist():
            frames, rows = np.nonzero((ids == identity) & counted)
            tracks.append(Track(frames.astype(np.int64), recording.boxes[frames, rows]))
        return tracks

    def answered_tracks(self, row: int) -> list[Track]:
        """What one observer has reported so far, without answers at people who do not count."""
        return self.scorer.tracks(row)

    def truth(self) -> dict[str, Any]:
        """What `info["truth"]` tells of the newest frame, arrays of N rows."""
        return {"boxes": self.boxes, "ids": self.ids, "visibility": self.visibility, "exists": self.exists}

    def scores(self) -> dict[str, Any]:
        """What `info` tells of the last answer, arrays of N rows: whether there is truth, and only then the scores."""
        scored = np.full(self.count, self.recording.scored)
        if not self.recording.scored:
            return {"scored": scored}
        return {
            "scored": scored,
            "ospa": self.ospa,
            "gospa": self.gospa,
            "location_error": self.location,
            "missed_error": self.missed,
            "false_error": self.false,
            "cardinality_error": self.cardinality_error,
        }

    def episode_scores(self) -> dict[str, Any]:
        """What `info` tells at an episode's end, arrays of N rows; nothing without truth."""
        if not self.recording.scored:
            return {}
        return {"ospa2": self.ospa2, "mota": self.mota, "idf1": self.idf1, "hota": self.hota}

    def privileged(self) -> dict[str, Array]:
        """What an oracle may know, besides the observation; arrays of N rows.

        Returns:
            `true_boxes` (N, n, 4), px; `true_ids` (N, n), 0 for nobody; `true_existence` (N, n), 0 or 1: who counts;
            `true_visibility` (N, n). n is 0 without truth.
        """
        return {
            "true_boxes": self.boxes.copy(),
            "true_ids": self.ids.astype(np.float64),
            "true_existence": self.exists.astype(np.float64),
            "true_visibility": self.visibility.copy(),
        }

    def debug_view(self, row: int = 0) -> str:
        """One observer's state as text, for debugging."""
        return (
            f"{self.recording.name}  frame {self.steps[row]}/{self.recording.horizon}  "
            f"people={int(self.exists[row].sum())}  reported={int(self.scorer.reported[row].sum())}  "
            f"ospa={self.ospa[row]:.2f}  gospa={self.gospa[row]:.2f}"
        )

    def _decode(self, row: int) -> None:
        """The next frame; a source that ends early, or breaks, ends the episode."""
        if not self._decodes:
            return
        try:
            self.images[row] = next(self._frames[row])
        except (SequenceError, StopIteration) as error:
            self._ended[row] = True
            gym.logger.warn(
                f"the episode ends after {self.steps[row]} of {self.recording.horizon} frames: "
                f"{str(error) or f'{self.recording.name} has no more'}"
            )

    def _observe(self, row: int) -> None:
        if self.recording.detections is None:
            self.observations[row] = self.images[row]
        else:
            self.observations[row] = self.recording.detections[self._frame(row)]

    def _frame(self, row: int) -> int:
        """The frame an observer is at; after the last one that one again."""
        return min(int(self.steps[row]), self.recording.horizon - 1)

    def _newest(self) -> None:
        recording = self.recording
        frames = np.minimum(self.steps, recording.horizon - 1)
        self.ids, self.boxes = recording.ids[frames], recording.boxes[frames]
        self.visibility = recording.visibility[frames]
        self.exists = (self.ids > 0) & (self.visibility >= COUNTED_FROM)

    def _finish(self, row: int) -> None:
        """Scores of a whole episode."""
        true, answered = self.true_tracks(row), self.answered_tracks(row)
        self.ospa2[row] = self.scorer.trajectory_score(row, stack_tracks(true, self.recording.horizon, 4))
        found = mot_scores(true, answered, box_distances, self.config.cutoff)
        self.mota[row], self.idf1[row], self.hota[row] = found.mota, found.idf1, found.hota
