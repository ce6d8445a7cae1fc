"""N pedestrian scenes at once: the one piece of bookkeeping behind the single and the vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import COUNTED_FROM, PedestrianConfig
from servotrack.envs.track.pedestrians.draw import Stage, occluder_places
from servotrack.envs.track.pedestrians.episode import draw_movement
from servotrack.envs.track.pedestrians.motion_sensor import MotionSensor
from servotrack.envs.track.pedestrians.movement import Movement
from servotrack.envs.track.pedestrians.replay import read_recording
from servotrack.envs.track.pedestrians.scene import Stream
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.metrics import Track, box_distances, mot_scores, point_distances, stack_tracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class PedestrianWorld:
    """N scenes with N observers, stepped together; arrays carry a leading axis of N, people have n = max_people rows.

    An observer sees frame k and answers with the people it believes in at k; `step` scores that answer and draws frame
    k + 1, of those scenes only whose episode is under way. A person has one row for life, who comes later may have it
    after. After `reset` and `step` the newest frame's truth lies in the public arrays below; copy what you keep.

    Args:
        config: The world's parameters.
        count: Number of scenes N.

    Attributes:
        observations: What agents see, as `config.observation` says: frames (N, H, W, 3) uint8, or sets of detections.
        images: The newest frames, N arrays of shape (H, W, 3).
        ids: Who is in a row, shape (N, n): identities from 1, 0 for nobody in the image.
        boxes: Shape (N, n, 4): left, top, width, height, px.
        visibility: Visible share of each, shape (N, n).
        exists: Who counts, shape (N, n): those of whom at least a fifth is visible.
        steps: Frames answered so far, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,).
        terminated: Never; shape (N,), bool.
        truncated: All frames answered, shape (N,), bool.
        ospa, gospa, location, missed, false: Of the last answer, shape (N,).
        cardinality_error: Reported people minus true ones, shape (N,), int.
        ospa2, mota, idf1, hota: Of the episode, shape (N,); 0 until `truncated`.
        scorer: Identities and reported rows of the last answer.
    """

    def __init__(self, config: PedestrianConfig, count: int) -> None:
        self.config, self.count = config, count
        self._recorded = read_recording(config) if config.script == "replay" else None
        n, dimension = config.max_people, 4 if config.answers_boxes else 2
        if config.observation == "pixels":
            self.observations: NDArray[Any] = np.zeros((count, config.height, config.width, 3), np.uint8)
        else:
            self.observations = np.zeros((count, config.measurement_rows, 1 + dimension))
        blank = np.zeros((config.height, config.width, 3), np.uint8)
        self.images: list[NDArray[np.uint8]] = [blank] * count
        self._stages: list[Stage | None] = [None] * count
        self._movements: list[Movement | None] = [None] * count
        self._sensors: list[MotionSensor | None] = [None] * count
        frames = config.horizon + 1
        self._ids, self._boxes = np.zeros((count, frames, n), np.int64), np.zeros((count, frames, n, 4))
        self._visibility = np.zeros((count, frames, n))
        self._distances = box_distances if config.answers_boxes else point_distances
        self.scorer = SetScorer(
            count, config.estimate_rows, dimension, config.horizon, config.score_cutoff, self._distances
        )
        self.steps = np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)
        self.mota, self.idf1, self.hota = np.zeros(count), np.zeros(count), np.zeros(count)
        self._newest()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows; the others are left as they are, to the bit.

        Args:
            rows: Which of the N.
            seeds: One episode seed for each, non-negative integers.

        Raises:
            ValueError: A recording with more people at a time than `max_people`.
        """
        config = self.config
        for row, seed in zip(rows, seeds, strict=True):
            stage = Stage(config, seed)
            self._stages[row] = stage
            self._movements[row] = draw_movement(config, seed, self._recorded, occluder_places(config, seed))
            if config.observation != "pixels":
                self._sensors[row] = MotionSensor(config, stage, Streams(seed)[Stream.SHUFFLE])
            self._ids[row], self._boxes[row], self._visibility[row] = 0, 0.0, 0.0
            self.scorer.reset(row)
            self.steps[row], self.truncated[row] = 0, False
            self.ospa2[row] = self.mota[row] = self.idf1[row] = self.hota[row] = 0.0
            self._draw(row)
        self._newest()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score every row's answer to its newest frame, and show the next frame.

        Args:
            answers: Shape (N, rows, 1 + d): existence, then boxes or centroids, px.
            running: Which of the N have an episode under way, (N,) bool; None for all. The others wait for their reset
                at the frame they are at.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        hidden = (self.ids > 0) & ~self.exists
        scores = self.scorer.score(answers, self._answerable(self.boxes), self.exists, self.steps, hidden)
        self.ospa, self.cardinality_error = scores.ospa, scores.cardinality_error
        self.gospa, self.location, self.missed, self.false = scores.gospa
        self.reward = -scores.gospa.total / self.config.score_cutoff
        self.steps = self.steps + running
        self.truncated = self.steps >= self.config.horizon
        for row in np.flatnonzero(running).tolist():
            self._draw(row)
            if self.truncated[row]:
                self._finish(row)
        self._newest()

    def true_tracks(self, row: int) -> list[Track]:
        """True tracks of one scene's people at the frames answered so far, without those in which they do not count.

        Returns:
            One track per identity, in order; states are boxes, or centers where answers are centroids, px.
        """
        steps = int(self.steps[row])
        ids, states = self._ids[row, :steps], self._answerable(self._boxes[row, :steps])
        counted = self._visibility[row, :steps] >= COUNTED_FROM
        tracks = []
        for identity in np.unique(ids[counted & (ids > 0)]).tolist():
            frames, rows = np.nonzero((ids == identity) & counted)
            tracks.append(Track(frames.astype(np.int64), states[frames, rows]))
        return tracks

    def answered_tracks(self, row: int) -> list[Track]:
        """What one scene's observer has reported so far, without answers at people who do not count."""
        return self.scorer.tracks(row)

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
            `true_visibility` (N, n).
        """
        return {
            "true_boxes": self.boxes.copy(),
            "true_ids": self.ids.astype(np.float64),
            "true_existence": self.exists.astype(np.float64),
            "true_visibility": self.visibility.copy(),
        }

    def debug_view(self, row: int = 0) -> str:
        """One scene's state as text, for debugging."""
        return (
            f"frame {self.steps[row]}/{self.config.horizon}  people={int(self.exists[row].sum())}  "
            f"hidden={int(((self.ids[row] > 0) & ~self.exists[row]).sum())}  "
            f"reported={int(self.scorer.reported[row].sum())}  ospa={self.ospa[row]:.2f}  "
            f"gospa={self.gospa[row]:.2f}  cardinality {self.cardinality_error[row]:+d}"
        )

    def _draw(self, row: int) -> None:
        """Draw the frame that a scene is at, and take its truth in."""
        stage, movement, frame = self._stages[row], self._movements[row], int(self.steps[row])
        assert stage is not None and movement is not None
        people, rows = movement.people(frame)
        drawn = stage.draw(people, frame)
        self.images[row] = drawn.image
        inside = (drawn.boxes[:, 2] > 0.0) & (drawn.boxes[:, 3] > 0.0)
        self._ids[row, frame, rows] = np.where(inside, people.ids, 0)
        self._boxes[row, frame, rows] = drawn.boxes
        self._visibility[row, frame, rows] = np.where(inside, drawn.visibility, 0.0)
        sensor = self._sensors[row]
        if sensor is not None:
            self.observations[row] = sensor.observe(drawn.image, frame)
        elif self.count == 1:
            # A single scene's frame needs no copy to stand in an array of one.
            self.observations = drawn.image[None]
        else:
            self.observations[row] = drawn.image

    def _newest(self) -> None:
        rows = np.arange(self.count)
        self.ids, self.boxes = self._ids[rows, self.steps], self._boxes[rows, self.steps]
        self.visibility = self._visibility[rows, self.steps]
        self.exists = (self.ids > 0) & (self.visibility >= COUNTED_FROM)

    def _answerable(self, boxes: Array) -> Array:
        """Boxes as they are, or their centers where answers are centroids."""
        return boxes if self.config.answers_boxes else boxes[..., :2] + 0.5 * boxes[..., 2:]

    def _finish(self, row: int) -> None:
        """Scores of a whole episode."""
        true, answered, config = self.true_tracks(row), self.answered_tracks(row), self.config
        truth = stack_tracks(true, config.horizon, 4 if config.answers_boxes else 2)
        self.ospa2[row] = self.scorer.trajectory_score(row, truth)
        if not true and not answered:
            # The metrics are defined by shares of nothing then; who reports nobody where nobody is has made no error.
            self.mota[row] = self.idf1[row] = self.hota[row] = 1.0
            return
        found = mot_scores(true, answered, self._distances, config.score_cutoff)
        self.mota[row], self.idf1[row], self.hota[row] = found.mota, found.idf1, found.hota
