"""Input of a tracker, step by step: frames with a detector, or a MOTChallenge sequence's own detections."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from servotrack.baselines.agents.people.catalog import Detector
from servotrack.baselines.track_command.notices import CameraReport, Notices
from servotrack.envs.track.files.frames import SIDES, FrameSource, open_frames, resize, resized
from servotrack.envs.track.files.mot_files import SequenceInfo, find_mot_folder
from servotrack.envs.track.files.pixel_detections import read_pixel_detections
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.detect import Detections, PictureMotion, detections_from_boxes
from servotrack.estimators.types import Array, Image

_BACKGROUND_SPACING = 25
"""Largest spacing of the frames of the first pass. Wider sampling would mix different light into one background."""
_SHORT = 5.0
"""Length of a source below which people who stand or walk slowly fill the background of a first pass, s."""
_MAX_BACKGROUND = 1 << 32
"""Largest memory for the frames of the first pass, bytes."""
_NOTHING = detections_from_boxes(np.zeros((0, 4)))
_FITTED = (384, 288)
"""Largest frame for `fit`, px."""
NOMINAL_RATE = 25.0
"""Frame rate if the source has none, 1/s."""


class Step(NamedTuple):
    """One frame and its detections.

    Attributes:
        number: Number of the frame in the source, from 0.
        picture: Decoded RGB frame; None if the source has only detections.
        detections: Detections in working px.
        time: Time since frame 0, s.
        motion: Motion of the camera since the last step, see `PictureMotion.step`, in working px; None where it is
            unknown.
    """

    number: int
    picture: Image | None
    detections: Detections
    time: float
    motion: Array | None = None


class Input(Protocol):
    """Sequence that can be tracked.

    Attributes:
        name: Name for titles.
        frame_rate: Steps per second.
        length: Expected number of steps; None if unknown. Container headers may be wrong about it.
        source_size: Width and height of the source's frames, px; None if unknown.
        scale: Source px per working px, horizontally and vertically.
        warning: Reason why the steps ended early; empty if they did not.
        notes: Facts about the source for the user.
    """

    name: str
    frame_rate: float
    length: int | None
    source_size: tuple[int, int] | None
    scale: tuple[float, float]

    @property
    def notes(self) -> Sequence[str]:
        """Facts about the source for the user."""

    @property
    def warning(self) -> str:
        """Reason why the steps ended early; empty if they did not."""

    def __iter__(self) -> Iterator[Step]:
        """Yield the steps."""


class PixelInput:
    """Frames with the detections of a detector.

    Args:
        source: Source that `open_frames` accepts.
        detector: Detector of people.
        size: Width and height that the detector works at, px; "source" for the source's own; "fit" for the largest size
            of its shape within 384 by 288 px, for which the detectors' parameters were chosen.
        start: First frame, from 0.
        count: Largest number of frames; None for all.
        stride: Use every stride-th frame.
        background: Number of frames, at most 25 frames apart, that a first pass gives to the detector as background. 0
            starts from the first frame. A camera has no first pass, and a network needs none.
        white: Value that is white in images of more than 8 bits; None: from the images.
        moving: If true, the motion of the camera is estimated from the pictures, for a detector that does not need a
            still one.

    Raises:
        SequenceError: The source cannot be opened.
        ValueError: The frames of the first pass need more than 4 GiB.
    """

    def __init__(
        self,
        source: str | Path | int,
        detector: Detector,
        size: tuple[int, int] | str = "fit",
        *,
        start: int = 0,
        count: int | None = None,
        stride: int = 1,
        background: int = 0,
        white: float | None = None,
        moving: bool = False,
    ) -> None:
        self._motion = PictureMotion() if moving else None
        self._moves = CameraReport()
        self._facts: list[str] = []
        self._frames = open_frames(source, start=start, count=count, stride=stride, white=white)
        self._white = white
        self._notices = Notices()
        self._source, self._detector = source, detector
        self._start, self._stride = start, stride
        self._background = 0 if self._frames.live else background
        width, height = self._frames.source_size
        self._size = _working_size(size, (width, height))
        _check_background(min(self._background, self._frames.length or self._background), self._size)
        self.name = self._frames.name
        self.frame_rate = (self._frames.frame_rate or NOMINAL_RATE) / stride
        self.length: int | None = _steps(self._frames, start, count, stride)
        self.source_size: tuple[int, int] | None = (width, height)
        self.scale = (width / self._size[0], height / self._size[1])

    @property
    def notes(self) -> Sequence[str]:
        """Facts about the source, and sentences of the detector on what does not work."""
        return [*self._frames.notes, *self._facts, *self._notices.lines(), *self._moves.lines()]

    @property
    def warning(self) -> str:
        """Reason why the frames ended early; empty if they did not."""
        return self._frames.warning

    def __iter__(self) -> Iterator[Step]:
        """Decode, resize and detect; yield one step per frame."""
        state: Any = self._detector.initial(self._first_pass()) if self._background else None
        motion, seen = None, PictureMotion().initial()
        takes_time = "dt" in inspect.signature(self._detector.step).parameters
        before: float | None = None
        try:
            for number, time, picture in self._frames.numbered():
                frame = resize(picture, self._size)
                if state is None:
                    state = self._detector.initial(frame)
                if not self._notices.begun:
                    self._notices.take(number, state)
                now = self._time(number) if time is None else time
                known = {"dt": now - before} if takes_time and before is not None and now > before else {}
                state, found = self._detector.step(state, frame, **known)
                before = now
                self._notices.take(number, state)
                if self._motion is not None:
                    seen, motion = self._motion.step(seen, frame, found.boxes)
                    self._moves.take(number, motion, frame.shape)
                yield Step(number, picture, found, now, motion)
        finally:
            self._frames.close()

    def _time(self, number: int) -> float:
        return number / (self.frame_rate * self._stride)

    def _first_pass(self) -> list[Image]:
        known = self._frames.length or self._background * _BACKGROUND_SPACING
        spacing = min(max((known - self._start) // self._background, 1), _BACKGROUND_SPACING)
        spaced = open_frames(self._source, start=self._start, count=self._background, stride=spacing, white=self._white)
        found: list[Image] = []
        try:
            found.extend(resize(picture, self._size) for picture in spaced)
        except SequenceError:
            # Tracking stops at the same frame, and keeps the frames before it.
            if not found:
                raise
        seconds = ((len(found) - 1) * spacing + 1) / (self.frame_rate * self._stride)
        if seconds < _SHORT:
            self._facts.append(
                f"the frames for the background span {seconds:.1f} s: people who stand or walk slowly in them count as "
                "background; a longer source, or --background 0 where the first frame is empty, finds them"
            )
        return found


class FileInput:
    """Detections of a MOTChallenge sequence. Its images, if any, serve only for the video.

    Args:
        folder: Folder of the sequence.
        confidence: Smallest confidence of a detection; None for all.
        pictures: If true, read the images, too.
        length: Smallest number of steps, such as the length of the truth. Detections alone do not show where a sequence
            ends.
        start: First frame, from 0.
        count: Largest number of frames; None for all.
        stride: Use every stride-th frame.

    Raises:
        SequenceError: Missing or invalid detections.
    """

    scale = (1.0, 1.0)

    def __init__(
        self,
        folder: str | Path,
        *,
        confidence: float | None = None,
        pictures: bool = True,
        length: int = 0,
        start: int = 0,
        count: int | None = None,
        stride: int = 1,
    ) -> None:
        sequence = find_mot_folder(folder)
        if sequence is None or sequence.detections is None:
            raise SequenceError(f"{folder} holds no det/det.txt; give a MOTChallenge sequence or another detector")
        self._frames: FrameSource | None = None
        if pictures and sequence.images is not None:
            self._frames = open_frames(folder, start=start, stride=stride)
        self.source_size = _picture_size(self._frames, sequence.info)
        self._found, note = read_pixel_detections(sequence.detections, self.source_size)
        self._notes = [note] if note else []
        self._confidence = confidence
        self._numbers = range(start, max([length, *(step + 1 for step in self._found)]), stride)[:count]
        if not len(self._numbers):
            raise SequenceError(f"{sequence.detections} holds no detections from frame {start} on")
        self.name = sequence.info.name
        self.frame_rate = (sequence.info.frame_rate or NOMINAL_RATE) / stride
        self.length: int | None = len(self._numbers)
        self._rate = sequence.info.frame_rate or NOMINAL_RATE

    @property
    def notes(self) -> Sequence[str]:
        """Facts about the source for the user."""
        return [*self._notes, *([] if self._frames is None else self._frames.notes)]

    @property
    def warning(self) -> str:
        """Reason why the images ended early; empty if they did not."""
        return "" if self._frames is None else self._frames.warning

    def __iter__(self) -> Iterator[Step]:
        """Yield the detections of each frame, with its image if there is one."""
        pictures = iter(()) if self._frames is None else self._frames.numbered()
        newest = next(pictures, None)
        for number in self._numbers:
            while newest is not None and newest.number < number:
                newest = next(pictures, None)
            picture = newest.image if newest is not None and newest.number == number else None
            yield Step(number, picture, self._detections(number), number / self._rate)

    def _detections(self, number: int) -> Detections:
        found = self._found.get(number, _NOTHING)
        if self._confidence is None:
            return found
        kept = found.confidences >= self._confidence
        return Detections(*(values[kept] for values in found))


def _check_background(count: int, size: tuple[int, int]) -> None:
    needed = 3 * count * size[0] * size[1]
    if needed > _MAX_BACKGROUND:
        raise ValueError(
            f"background of {count} frames of {size[0]}x{size[1]} px needs {needed / 2**30:.1f} GiB, the limit is "
            f"{_MAX_BACKGROUND / 2**30:.0f}; set a smaller background or size"
        )


def _working_size(size: tuple[int, int] | str, source: tuple[int, int]) -> tuple[int, int]:
    if not isinstance(size, str):
        return size
    if size != "fit" or (source[0] <= _FITTED[0] and source[1] <= _FITTED[1]):
        return source
    wide = source[0] * _FITTED[1] > source[1] * _FITTED[0]
    return resized(source, *((_FITTED[0], None) if wide else (None, _FITTED[1])))


def _picture_size(frames: FrameSource | None, info: SequenceInfo) -> tuple[int, int] | None:
    if frames is not None:
        return frames.source_size
    if info.width is None or info.height is None or max(info.width, info.height) > SIDES[1]:
        return None
    return (info.width, info.height)


def _steps(frames: FrameSource, start: int, count: int | None, stride: int) -> int | None:
    if frames.length is None:
        return count
    known = max(-(-(frames.length - start) // stride), 0)
    return known if count is None else min(known, count)
