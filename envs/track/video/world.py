"""N observers of one recorded sequence: the one piece of bookkeeping behind the single and the vector environment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.envs.track.video.recording import Recording, VideoConfig, load_recording
from servotrack.estimators.types import Array, Image, Labels, Mask


class VideoWorld(PeopleWorld):
    """N observers of a sequence, each at a frame of its own; attributes as in `PeopleWorld`, and those below.

    An observer sees frame k and answers with the people it believes in at k; `step` scores that answer and shows frame
    k + 1, after the last frame that one again. Frames are decoded when they are needed, and none is kept.

    Args:
        config: The world's parameters.
        count: Number of observers N.
        pictures: Whether `images` are wanted where detections are observed.

    Attributes:
        recording: The sequence.
        observations: What agents see: frames (N, H, W, 3) uint8, or sets of detections (N, m, 5).

    Raises:
        SequenceError: A source or file that cannot be used.
    """

    def __init__(self, config: VideoConfig, count: int, pictures: bool = False) -> None:
        self.recording: Recording = load_recording(config)
        recording = self.recording
        super().__init__(count, recording.horizon, config.max_estimates, True, config.cutoff, recording.scored)
        self.config = config
        blank = np.full((recording.height, recording.width, 3), 74, np.uint8)
        self.images = [blank] * count
        self._decodes = recording.open is not None and (pictures or recording.detections is None)
        self._frames: list[Iterator[Image]] = [iter(()) for _ in range(count)]
        if recording.detections is None:
            self.observations: NDArray[Any] = np.zeros((count, *blank.shape), np.uint8)
        else:
            self.observations = np.zeros((count, *recording.detections.shape[1:]))
        self._ended = np.zeros(count, np.bool_)
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
            self._begin(row)
            self._ended[row] = False
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
        self._score(answers)
        self.steps = self.steps + running
        for row in np.flatnonzero(running).tolist():
            if self.steps[row] < self.recording.horizon:
                self._decode(row)
        self.truncated = (self.steps >= self.recording.horizon) | self._ended
        for row in np.flatnonzero(running).tolist():
            self._observe(row)
            if self.truncated[row]:
                self._finish(row)
        self._newest()

    def close(self) -> None:
        """Let go of files and cameras."""
        self._frames = [iter(()) for _ in range(self.count)]

    def scores(self) -> dict[str, Any]:
        """What `info` tells of the last answer, arrays of N rows: whether there is truth, and only then the scores."""
        return {"scored": np.full(self.count, self.scored)} | (super().scores() if self.scored else {})

    def episode_scores(self) -> dict[str, Any]:
        """What `info` tells at an episode's end, arrays of N rows; nothing without truth."""
        return super().episode_scores() if self.scored else {}

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

    def _past(self, row: int) -> tuple[Labels, Array, Array]:
        recording, steps = self.recording, int(self.steps[row])
        return recording.ids[:steps], recording.boxes[:steps], recording.visibility[:steps]

    def _newest(self) -> None:
        recording = self.recording
        frames = np.minimum(self.steps, recording.horizon - 1)
        self._note_truth(recording.ids[frames], recording.boxes[frames], recording.visibility[frames])
