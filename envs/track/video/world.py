"""N observers of one recorded sequence, for the single and the vector environment."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.envs.track.video.recording import Recording, VideoConfig, load_recording
from servotrack.estimators.types import Array, Image, Labels, Mask


class VideoWorld(PeopleWorld):
    """N observers of a sequence, each at its own frame. Attributes: see `PeopleWorld`, and below.

    The observer gets frame k and answers with its estimate of the set of people in frame k. `step` scores the answer
    and advances to frame k + 1; the last frame is repeated at the end. Frames are decoded when they are needed and not
    kept.

    Args:
        config: Parameters of the environment.
        count: Number of observers N.
        pictures: If True, frames are decoded for `images` even if detections are observed.

    Attributes:
        recording: Sequence.
        observations: Frames, shape (N, H, W, 3), uint8, or sets of detections, shape (N, m, 5).

    Raises:
        SequenceError: If the source or a file cannot be used.
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
        self._ended, self._decoded = np.zeros(count, np.bool_), np.zeros(count, np.int64)
        self._newest()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Restart some rows at the first frame. The other rows do not change.

        Args:
            rows: Indices of the observers.
            seeds: Episode seed of each; not used.

        Raises:
            SequenceError: If the first frame cannot be decoded.
        """
        for row, seed in zip(rows, seeds, strict=True):
            self._begin(row, seed)
            self._ended[row] = False
            if self._decodes:
                assert self.recording.open is not None
                self._frames[row] = self.recording.open()
                self.images[row], self._decoded[row] = next(self._frames[row]), 1
            self._observe(row)
        self._newest()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers to the newest frames, and advance to the next frames.

        Args:
            answers: Existence and boxes (px), shape (N, rows, 5).
            running: True for observers whose episode is running, shape (N,), bool; None: all. The others stay at their
                frame until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        self._score(answers)
        self.steps = self.steps + running
        for row in np.flatnonzero(running).tolist():
            self._advance(row)
        self.truncated = (self.steps >= self.recording.horizon) | self._ended
        for row in np.flatnonzero(running & self.truncated).tolist():
            self._finish(row)
        self._newest()

    def get_state(self) -> State:
        """Return the exact state: the steps, and the scores so far.

        Raises:
            ValueError: The source is a camera, whose frames do not come back.
        """
        if isinstance(self.config.source, int):
            raise ValueError(f"source={self.config.source} is a camera: it has no state, for its frames do not return")
        return super().get_state()

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy, without the open files."""
        return {name: value for name, value in self.__dict__.items() if name not in ("recording", "_frames")}

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Take over the attributes of the copied world, and open the files again at its frames."""
        self.__dict__.update(attributes)
        self.recording = load_recording(self.config)
        self._frames = [self._opened_after(count) for count in self._decoded.tolist()]

    def _opened_after(self, count: int) -> Iterator[Image]:
        """Return the frames of the source after the first `count`."""
        if count == 0:
            return iter(())
        assert self.recording.open is not None
        frames = self.recording.open()
        next(itertools.islice(frames, count - 1, None))
        return frames

    def close(self) -> None:
        """Close files and cameras."""
        self._frames = [iter(()) for _ in range(self.count)]

    def scores(self) -> dict[str, Any]:
        """Return the entries of `info` for the last answer, arrays of N rows; without ground truth only `scored`."""
        return {"scored": np.full(self.count, self.scored)} | (super().scores() if self.scored else {})

    def episode_scores(self) -> dict[str, Any]:
        """Return the entries of `info` at the end of an episode, arrays of N rows; empty without ground truth."""
        return super().episode_scores() if self.scored else {}

    def debug_view(self, row: int = 0) -> str:
        """Return the state of an observer as text, for debugging."""
        return (
            f"{self.recording.name}  frame {self.steps[row]}/{self.recording.horizon}  "
            f"people={int(self.exists[row].sum())}  reported={int(self.scorer.reported[row].sum())}  "
            f"ospa={self.ospa[row]:.2f}  gospa={self.gospa[row]:.2f}"
        )

    def _decode(self, row: int) -> None:
        """Decode the next frame. The episode ends if the source ends early or fails."""
        if not self._decodes:
            return
        try:
            self.images[row] = next(self._frames[row])
            self._decoded[row] += 1
        except (SequenceError, StopIteration) as error:
            self._ended[row] = True
            gym.logger.warn(
                f"the episode ends after {self.steps[row]} of {self.recording.horizon} frames: "
                f"{str(error) or f'{self.recording.name} has no more frames'}"
            )

    def _advance(self, row: int) -> None:
        if self.steps[row] < self.recording.horizon:
            self._decode(row)
        self._observe(row)

    def _observe(self, row: int) -> None:
        if self.recording.detections is None:
            self.observations[row] = self.images[row]
        else:
            self.observations[row] = self.recording.detections[self._frame(row)]

    def _frame(self, row: int) -> int:
        """Return the index of an observer's frame; the last frame is repeated."""
        return min(int(self.steps[row]), self.recording.horizon - 1)

    def _past(self, row: int) -> tuple[Labels, Array, Array]:
        recording, steps = self.recording, int(self.steps[row])
        return recording.ids[:steps], recording.boxes[:steps], recording.visibility[:steps]

    def _newest(self) -> None:
        recording = self.recording
        frames = np.minimum(self.steps, recording.horizon - 1)
        self._note_truth(recording.ids[frames], recording.boxes[frames], recording.visibility[frames])
