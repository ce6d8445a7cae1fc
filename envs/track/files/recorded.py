"""Recorded tracks: what a file of truth or of results holds, whichever format it is in."""

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
"""Latest frame that is believed: four days at 25 frames per second. Beyond it a number is a slip of the pen."""
MAX_ROWS = 10_000_000
"""Most boxes of a file."""
MAX_PIXELS = 1e6
"""Largest coordinate or size of a box that is believed, px."""
_MAX_ID = 2**53


class SequenceError(ValueError):
    """A file of a recorded sequence that cannot be used; the message names file, line and remedy."""


class PeopleInFrame(NamedTuple):
    """Who is in one frame of a recorded sequence.

    Attributes:
        ids: Increasing. Shape (k,), int.
        boxes: Left, top, width, height. Shape (k, 4), px.
        visibilities: Visible share of each, from 0 to 1. Shape (k,).
    """

    ids: Labels
    boxes: Array
    visibilities: Array


@dataclass(frozen=True)
class RecordedTracks:
    """All identities of a recorded sequence.

    Attributes:
        ids: As the file has them, increasing. Shape (n,), int.
        tracks: One per identity; steps count frames from 0; states are boxes (left, top, width, height). n of them, px.
        visibilities: Visible share of each box, from 0 to 1; 1 where the file does not tell. n arrays of shape (k,).
    """

    ids: Labels
    tracks: list[Track]
    visibilities: list[Array]

    @property
    def length(self) -> int:
        """Steps up to the last box."""
        return max((int(track.steps[-1]) + 1 for track in self.tracks), default=0)

    def by_frame(self) -> Mapping[int, PeopleInFrame]:
        """Who is in each frame (from 0) that has anybody."""
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
    """Frames cut out of whole arrays when they are asked for: hours of them would fill the memory."""

    def __init__(self, frames: Labels, bounds: Labels, everybody: PeopleInFrame) -> None:
        self._frames, self._bounds, self._everybody = frames, bounds, everybody

    def __getitem__(self, frame: int) -> PeopleInFrame:
        at = int(np.searchsorted(self._frames, frame))
        if at == len(self._frames) or self._frames[at] != frame:
            raise KeyError(frame)
        inside = slice(self._bounds[at], self._bounds[at + 1])
        ids, boxes, visibilities = self._everybody
        return PeopleInFrame(ids[inside], boxes[inside], visibilities[inside])

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames.tolist())

    def __len__(self) -> int:
        return len(self._frames)


class TrackRows:
    """Collects the rows of a file, checks each, and makes tracks of them.

    Args:
        path: The file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values = array("d")
        self._keys = array("q")

    def fail(self, line: int, message: str) -> SequenceError:
        """The error to raise for a line."""
        return SequenceError(f"{self.path}, line {line}: {message}")

    def add(self, line: int, step: int, identity: int, box: tuple[float, float, float, float], visible: float) -> None:
        """Take in one box.

        Args:
            line: Where it stands in the file.
            step: Frame, from 0.
            identity: At least 0.
            box: Left, top, width, height, px.
            visible: Visible share, 0 to 1.

        Raises:
            SequenceError: A number out of its range, or too many rows.
        """
        if not 0 <= step < MAX_FRAME:
            raise self.fail(line, f"frame must be one of the first {MAX_FRAME}, got {step} (counted from 0)")
        if not 0 <= identity < _MAX_ID:
            raise self.fail(line, f"ids of tracks must be whole numbers of at least 0, got {identity}")
        self.check_box(line, box)
        if not 0.0 <= visible <= 1.0:
            raise self.fail(line, f"visibility must lie in [0, 1], got {visible:g}")
        if len(self._keys) >= 3 * MAX_ROWS:
            raise self.fail(line, f"a file must hold at most {MAX_ROWS} boxes; split it")
        self._values.extend((*box, visible))
        self._keys.extend((identity, step, line))

    def check_box(self, line: int, box: tuple[float, float, float, float]) -> None:
        """Raises SequenceError where a box is not finite, far outside any image, or of negative size."""
        if not all(math.isfinite(value) and abs(value) <= MAX_PIXELS for value in box):
            raise self.fail(line, f"boxes must be finite, within {MAX_PIXELS:g} px, got {_numbers(box)}")
        if box[2] < 0.0 or box[3] < 0.0:
            raise self.fail(line, f"width and height must be at least 0, got {_numbers(box)}")

    def finish(self) -> RecordedTracks:
        """The tracks.

        Raises:
            SequenceError: An identity twice in a frame.
        """
        keys = np.array(self._keys, dtype=np.int64).reshape(-1, 3)
        values = np.array(self._values, dtype=np.float64).reshape(-1, 5)
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


def check_file(path: Path) -> Path:
    """Raises SequenceError unless the path is a file."""
    if path.is_dir():
        raise SequenceError(f"{path} is a folder; name the file")
    try:
        there = path.is_file()
    except (OSError, ValueError) as error:
        raise SequenceError(f"{str(path)!r} cannot be a file ({error})") from error
    if not there:
        raise SequenceError(f"{path} does not exist, or is no plain file; check the path")
    return path


def _numbers(box: tuple[float, float, float, float]) -> str:
    return ", ".join(f"{value:g}" for value in box)
