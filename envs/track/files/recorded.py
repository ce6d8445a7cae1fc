"""Recorded tracks: the common content of ground-truth and result files of all formats."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.estimators.metrics.tracks import Track
from servotrack.estimators.types import Array, Labels

MAX_FRAME = 10_000_000
"""Number of accepted frames (four days at 25 frames per second). Larger frame numbers are rejected as errors."""
MAX_ROWS = 10_000_000
"""Maximum number of boxes in a file."""
FRAME_RATES = (0.1, 1000.0)
"""Range of plausible frame rates, frames per second."""
MAX_IN_FRAME = 5000
"""Maximum number of boxes in a frame. Trackers need time and memory in proportion to its square."""
MAX_PIXELS = 1e6
"""Largest accepted coordinate or size of a box, px."""
_MAX_ID = 2**53


class SequenceError(ValueError):
    """Error in a file of a recorded sequence. The message names file, line and remedy."""


class PeopleInFrame(NamedTuple):
    """People in one frame of a recorded sequence.

    Attributes:
        ids: Identities, increasing, shape (k,), int.
        boxes: Left, top, width, height, shape (k, 4), px.
        visibilities: Visible shares from 0 to 1, shape (k,).
    """

    ids: Labels
    boxes: Array
    visibilities: Array


@dataclass(frozen=True)
class RecordedTracks:
    """Tracks of all identities of a recorded sequence.

    Attributes:
        ids: Identities of the file, increasing, shape (n,), int.
        tracks: One track per identity. Steps count frames from 0; states are boxes (left, top, width, height), px.
        visibilities: Visible shares of the boxes of each track, 0 to 1; 1 if the file has none. n arrays of shape (k,).
    """

    ids: Labels
    tracks: list[Track]
    visibilities: list[Array]

    @property
    def length(self) -> int:
        """Number of steps up to the last box."""
        return max((int(track.steps[-1]) + 1 for track in self.tracks), default=0)

    def by_frame(self) -> Mapping[int, PeopleInFrame]:
        """Return the people in each frame (from 0) that has any."""
        if not self.tracks:
            return {}
        steps = np.concatenate([track.steps for track in self.tracks])
        order = np.argsort(steps, kind="stable")
        frames, starts = np.unique(steps[order], return_index=True)
        return _Frames(
            frames,
            np.append(starts, len(steps)),
            PeopleInFrame(
                np.repeat(self.ids, [len(track.steps) for track in self.tracks])[order],
                np.concatenate([track.states for track in self.tracks])[order],
                np.concatenate(self.visibilities)[order],
            ),
        )


class _Frames(Mapping[int, PeopleInFrame]):
    """Frames as slices of whole arrays, made on access: one object per frame would need too much memory."""

    def __init__(self, frames: Labels, bounds: Labels, people: PeopleInFrame) -> None:
        self._frames, self._bounds, self._people = frames, bounds, people

    def __getitem__(self, frame: int) -> PeopleInFrame:
        at = int(np.searchsorted(self._frames, frame))
        if at == len(self._frames) or self._frames[at] != frame:
            raise KeyError(frame)
        inside = slice(self._bounds[at], self._bounds[at + 1])
        ids, boxes, visibilities = self._people
        return PeopleInFrame(ids[inside], boxes[inside], visibilities[inside])

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames.tolist())

    def __len__(self) -> int:
        return len(self._frames)


class TrackRows:
    """Collector of the rows of a file: checks each row and builds the tracks.

    Args:
        path: Path of the file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values = array("d")
        self._keys = array("q")

    def fail(self, line: int, message: str) -> SequenceError:
        """Return the error to raise for a line."""
        return SequenceError(f"{self.path}, line {line}: {message}")

    def add(self, line: int, step: int, identity: int, box: tuple[float, float, float, float], visible: float) -> None:
        """Add one box.

        Args:
            line: Line number in the file.
            step: Frame, from 0.
            identity: Identity, at least 0.
            box: Left, top, width, height, px.
            visible: Visible share, 0 to 1.

        Raises:
            SequenceError: If a number is out of its range or there are too many rows.
        """
        if not 0 <= identity < _MAX_ID:
            raise self.fail(line, f"ids of tracks must be whole numbers of at least 0, got {identity}")
        if not 0.0 <= visible <= 1.0:
            raise self.fail(line, f"visibility must lie in [0, 1], got {visible:g}")
        self._append(line, step, identity, box, visible)

    def add_detection(self, line: int, step: int, box: tuple[float, float, float, float], confidence: float) -> None:
        """Add one box without identity.

        Args:
            line: Line number in the file.
            step: Frame, from 0.
            box: Left, top, width, height, px.
            confidence: Confidence, on any scale.

        Raises:
            SequenceError: If a number is out of its range or there are too many rows.
        """
        if not math.isfinite(confidence):
            raise self.fail(line, f"confidence must be finite, got {confidence:g}")
        self._append(line, step, 0, box, confidence)

    def _append(
        self, line: int, step: int, identity: int, box: tuple[float, float, float, float], value: float
    ) -> None:
        if not 0 <= step < MAX_FRAME:
            raise self.fail(line, f"frame must be one of the first {MAX_FRAME}, got {step} (counted from 0)")
        self._check_box(line, box)
        if len(self._keys) >= 3 * MAX_ROWS:
            raise self.fail(line, f"a file must hold at most {MAX_ROWS} boxes; split the file")
        self._values.extend((*box, value))
        self._keys.extend((identity, step, line))

    def _check_box(self, line: int, box: tuple[float, float, float, float]) -> None:
        """Raise SequenceError if a box is not finite, far outside any image, or of negative size."""
        if not all(math.isfinite(value) and abs(value) <= MAX_PIXELS for value in box):
            raise self.fail(line, f"boxes must be finite, within {MAX_PIXELS:g} px, got {_numbers(box)}")
        if box[2] < 0.0 or box[3] < 0.0:
            raise self.fail(line, f"width and height must be at least 0, got {_numbers(box)}")

    def finish(self) -> RecordedTracks:
        """Return the tracks.

        Raises:
            SequenceError: If an identity is twice in a frame, or a frame holds too many boxes.
        """
        keys, values = self._arrays()
        order = np.lexsort((keys[:, 2], keys[:, 1], keys[:, 0]))
        keys, values = keys[order], values[order]
        twice = np.flatnonzero((np.diff(keys[:, 0]) == 0) & (np.diff(keys[:, 1]) == 0))
        if len(twice):
            identity, _, line = keys[twice[0] + 1].tolist()
            first = int(keys[twice[0], 2])
            raise self.fail(line, f"id {identity} is in this frame already, in line {first}; keep one of the two")
        ids, starts = np.unique(keys[:, 0], return_index=True)
        bounds = [*starts.tolist(), len(keys)]
        parts = [slice(a, b) for a, b in pairwise(bounds)]
        return RecordedTracks(
            ids,
            [Track(keys[part, 1].copy(), values[part, :4].copy()) for part in parts],
            [values[part, 4].copy() for part in parts],
        )

    def listed(self) -> tuple[Labels, Labels, Array]:
        """Return frames (from 0) and identities, shape (n,), and boxes, shape (n, 4), in the order of the file.

        Raises:
            SequenceError: If a frame holds too many boxes.
        """
        keys, values = self._arrays()
        return keys[:, 1].copy(), keys[:, 0].copy(), values[:, :4].copy()

    def by_frame(self) -> tuple[Labels, Labels, Array]:
        """Return the boxes in the order of their frames, and of the file within a frame.

        Returns:
            frames: Frames with boxes, from 0, increasing, shape (f,).
            bounds: Index of the first box of each frame, then the number of boxes, shape (f + 1,).
            rows: Left, top, width, height, px, and visible share or confidence, shape (n, 5).

        Raises:
            SequenceError: If a frame holds too many boxes.
        """
        keys, values = self._arrays()
        order = np.argsort(keys[:, 1], kind="stable")
        frames, starts = np.unique(keys[order, 1], return_index=True)
        return frames, np.append(starts, len(keys)), values[order]

    def _arrays(self) -> tuple[Labels, Array]:
        keys = np.array(self._keys, dtype=np.int64).reshape(-1, 3)
        frames, counts = np.unique(keys[:, 1], return_counts=True)
        if len(counts) and counts.max() > MAX_IN_FRAME:
            frame = int(frames[np.argmax(counts)])
            raise SequenceError(
                f"{self.path}: frame {frame} (counted from 0) holds {counts.max()} boxes, the limit is {MAX_IN_FRAME}; "
                "keep the most confident ones"
            )
        return keys, np.array(self._values, dtype=np.float64).reshape(-1, 5)


def _numbers(box: tuple[float, float, float, float]) -> str:
    return ", ".join(f"{value:g}" for value in box)
