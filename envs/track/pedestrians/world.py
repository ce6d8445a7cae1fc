"""N pedestrian scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.draw import Stage, occluder_places
from servotrack.envs.track.pedestrians.episode import draw_movement
from servotrack.envs.track.pedestrians.motion_sensor import MotionSensor
from servotrack.envs.track.pedestrians.movement import Movement
from servotrack.envs.track.pedestrians.replay import read_recording
from servotrack.envs.track.pedestrians.scene import Stream
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.estimators.types import Array, Labels, Mask


class PedestrianWorld(PeopleWorld):
    """N scenes with one observer each, stepped together. Attributes: see `PeopleWorld`, and below.

    The observer gets frame k and answers with its estimate of the set of people in frame k. `step` scores the answer
    and renders frame k + 1 of the scenes whose episode is running. A person keeps one row; after the person has left, a
    later one may get the row. After `reset` and `step` the attributes describe the newest frame; copy them to keep
    them.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        observations: Frames, shape (N, H, W, 3), uint8, or sets of detections, depending on `config.observation`.
    """

    def __init__(self, config: PedestrianConfig, count: int) -> None:
        super().__init__(count, config.horizon, config.estimate_rows, config.answers_boxes, config.score_cutoff)
        self.config = config
        self._recorded = read_recording(config) if config.script == "replay" else None
        n = config.max_people
        if config.observation == "pixels":
            self.observations: NDArray[Any] = np.zeros((count, config.height, config.width, 3), np.uint8)
        else:
            self.observations = np.zeros((count, config.measurement_rows, 1 + self._dimension))
        blank = np.zeros((config.height, config.width, 3), np.uint8)
        self.images = [blank] * count
        self._stages: list[Stage | None] = [None] * count
        self._movements: list[Movement | None] = [None] * count
        self._sensors: list[MotionSensor | None] = [None] * count
        frames = config.horizon + 1
        self._ids, self._boxes = np.zeros((count, frames, n), np.int64), np.zeros((count, frames, n, 4))
        self._visibility = np.zeros((count, frames, n))
        self._newest()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change.

        Args:
            rows: Indices of the scenes.
            seeds: Episode seed of each, non-negative integers.

        Raises:
            ValueError: If the recording has more people at a time than `max_people`.
        """
        config = self.config
        for row, seed in zip(rows, seeds, strict=True):
            stage = Stage(config, seed)
            self._stages[row] = stage
            self._movements[row] = draw_movement(config, seed, self._recorded, occluder_places(config, seed))
            if config.observation != "pixels":
                self._sensors[row] = MotionSensor(config, stage, Streams(seed)[Stream.SHUFFLE])
            self._ids[row], self._boxes[row], self._visibility[row] = 0, 0.0, 0.0
            self._begin(row, seed)
            self._advance(row)
        self._newest()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers to the newest frames, and advance to the next frames.

        Args:
            answers: Existence, then boxes or centroids (px), shape (N, rows, 1 + d).
            running: True for scenes whose episode is running, shape (N,), bool; None: all. The other scenes stay at
                their frame until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        self._score(answers)
        self.steps = self.steps + running
        self.truncated = self.steps >= self.config.horizon
        for row in np.flatnonzero(running).tolist():
            self._advance(row)
            if self.truncated[row]:
                self._finish(row)
        self._newest()

    def debug_view(self, row: int = 0) -> str:
        """Return the state of a scene as text, for debugging."""
        return (
            f"frame {self.steps[row]}/{self.config.horizon}  people={int(self.exists[row].sum())}  "
            f"hidden={int(((self.ids[row] > 0) & ~self.exists[row]).sum())}  "
            f"reported={int(self.scorer.reported[row].sum())}  ospa={self.ospa[row]:.2f}  "
            f"gospa={self.gospa[row]:.2f}  cardinality {self.cardinality_error[row]:+d}"
        )

    def _advance(self, row: int) -> None:
        """Render the current frame of a scene, and store its ground truth."""
        stage, movement, frame = self._stages[row], self._movements[row], int(self.steps[row])
        assert stage is not None and movement is not None
        people, rows = movement.people(frame)
        drawn = stage.draw(people, frame)
        self.images[row] = drawn.image
        inside = (drawn.boxes[:, 2] > 0.0) & (drawn.boxes[:, 3] > 0.0)
        self._ids[row, frame][rows] = people.ids * inside
        self._boxes[row, frame][rows] = drawn.boxes
        self._visibility[row, frame][rows] = drawn.visibility * inside
        sensor = self._sensors[row]
        if sensor is not None:
            self.observations[row] = sensor.observe(drawn.image, frame)
        elif self.count == 1:
            # The frame of a single scene becomes an array of one without a copy.
            self.observations = drawn.image[None]
        else:
            self.observations[row] = drawn.image

    def _past(self, row: int) -> tuple[Labels, Array, Array]:
        steps = int(self.steps[row])
        return self._ids[row, :steps], self._boxes[row, :steps], self._visibility[row, :steps]

    def _newest(self) -> None:
        rows = np.arange(self.count)
        self._note_truth(self._ids[rows, self.steps], self._boxes[rows, self.steps], self._visibility[rows, self.steps])
