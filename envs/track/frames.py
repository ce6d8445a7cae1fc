"""Frames of recorded and live sequences: one iterator over videos, image folders, cameras and MOTChallenge folders."""

from __future__ import annotations

import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.mot_files import find_mot_folder
from servotrack.envs.track.recorded import SequenceError

Frame = NDArray[np.uint8]

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
SIDES = (8, 16384)
"""Smallest and largest side that frames may be resized to, px."""
_ATTEMPTS = 5
"""Times in a row that a decoder may deliver nothing before the sequence counts as over."""
_TIMEOUT = 10_000
"""Longest wait of OpenCV for a frame, ms."""
_FRAME_RATES = (0.1, 1000.0)
"""Frame rates outside are a container's slip, per second."""


class FrameSource:
    """The frames of a sequence, RGB, uint8, all of one size; `open_frames` makes it.

    Every iteration starts anew at the first frame, except over a camera, which goes on. Frames are decoded one by one;
    none is kept. Gray images get three equal channels, of 16-bit images the high byte counts, alpha is dropped, and
    an orientation that a camera noted is not applied. OpenCV brings a video whose size changes to that of its first
    frame; in a folder such a change is an error.

    Attributes:
        name: For titles and messages.
        frame_rate: Frames of the source per second; None where it does not tell.
        source_size: Width and height as decoded, px.
        size: Width and height of the frames that are delivered, px.
        length: Frames that the source claims to have; None where it does not tell. It may lie.
        live: Whether it is a camera.
        warning: Why the newest iteration ended earlier than the source claims; empty where it did not.
    """

    def __init__(
        self, reader: _Reader, width: int | None, height: int | None, start: int, count: int | None, stride: int
    ) -> None:
        self._reader = reader
        self._start, self._count, self._stride = start, count, stride
        self.name, self.live, self.warning = reader.name, reader.live, ""
        try:
            reader.open()
            first = reader.read()
        except BaseException:
            reader.close()
            raise
        if first is None:
            reader.close()
            raise SequenceError(f"{self.name} holds no frame that can be decoded; check that it plays elsewhere")
        _rgb(first, self.name)
        self.length, self.frame_rate = reader.length, reader.frame_rate
        self.source_size = (first.shape[1], first.shape[0])
        self.size = _resized(self.source_size, width, height)
        if not self.live:
            reader.close()

    def __iter__(self) -> Iterator[Frame]:
        """Frames, from `start` on.

        Raises:
            SequenceError: A frame that cannot be decoded, or of another size than the first; no frame at all.
        """
        reader, self.warning = self._reader, ""
        position = delivered = 0
        try:
            reader.open()
            while self._count is None or delivered < self._count:
                wanted = position >= self._start and (position - self._start) % self._stride == 0
                if not wanted:
                    if not reader.skip():
                        break
                    position += 1
                    continue
                image = reader.read()
                if image is None:
                    break
                yield self._deliver(image, position)
                position += 1
                delivered += 1
            else:
                return
        finally:
            if not self.live:
                reader.close()
        self._check_end(position, delivered)

    def close(self) -> None:
        """Let go of the camera or file."""
        self._reader.close()

    def _deliver(self, image: NDArray[Any], position: int) -> Frame:
        where = f"{self.name}, frame {position}{self._reader.detail(position)}"
        if (image.shape[1], image.shape[0]) != self.source_size:
            raise SequenceError(
                f"{where}: it has {image.shape[1]}x{image.shape[0]} px, the first one "
                f"{self.source_size[0]}x{self.source_size[1]}; bring all to one size"
            )
        return resize(_rgb(image, where), self.size)

    def _check_end(self, position: int, delivered: int) -> None:
        if delivered == 0:
            raise SequenceError(
                f"{self.name} ends after {position} frame(s), before the first wanted one; start was {self._start}"
            )
        claimed = self.length
        if self.live:
            self.warning = f"{self.name} delivers no more frames after frame {position}"
        elif claimed is not None and claimed - position > max(2, claimed // 100):
            self.warning = (
                f"{self.name}: no frame can be decoded after frame {position - 1}, though {claimed} are claimed; "
                "the file is truncated or damaged, or its count is wrong"
            )


def open_frames(
    source: str | Path | int,
    *,
    width: int | None = None,
    height: int | None = None,
    start: int = 0,
    count: int | None = None,
    stride: int = 1,
) -> FrameSource:
    """Open a sequence.

    Args:
        source: A video file, a folder of images (taken in the order of the numbers in their names), the folder of a
            MOTChallenge sequence, or a camera's index.
        width: Resize to this, px; with only one of the two, the shape is kept.
        height: Resize to this, px.
        start: First frame, counted from 0.
        count: Most frames; None for all.
        stride: Take every so manieth frame.

    Raises:
        SequenceError: Nothing there, nothing in it, or nothing that can be decoded.
        ValueError: Another argument out of its range.
    """
    for name, value, low, high in (
        ("width", width, *SIDES),
        ("height", height, *SIDES),
        ("start", start, 0, math.inf),
        ("count", count, 1, math.inf),
        ("stride", stride, 1, math.inf),
    ):
        if value is not None and (isinstance(value, bool) or int(value) != value or not low <= value <= high):
            raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")
    return FrameSource(_reader(source), width, height, int(start), count, int(stride))


def resize(image: Frame, size: tuple[int, int]) -> Frame:
    """An image brought to (width, height), by areas where it shrinks; itself where it has that size."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    shrinks = size[0] < image.shape[1] or size[1] < image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)  # type: ignore[return-value]


def _resized(size: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    if width is None and height is None:
        return size
    if width is None:
        assert height is not None
        width = max(round(size[0] * height / size[1]), 1)
    elif height is None:
        height = max(round(size[1] * width / size[0]), 1)
    return int(width), int(height)


def _reader(source: str | Path | int) -> _Reader:
    if isinstance(source, (int, np.integer)) and not isinstance(source, bool):
        return _Camera(int(source))
    text, path = str(source), Path(source)
    try:
        if path.is_dir():
            return _folder_reader(path)
        there = path.is_file()
    except (OSError, ValueError) as error:
        raise SequenceError(f"source {text!r} cannot be a path ({error})") from error
    if not there and text.isascii() and text.isdigit():
        return _Camera(int(text))
    if not there:
        raise SequenceError(f"source {text!r} does not exist: give a video file, an image folder or a camera's index")
    if path.stat().st_size == 0:
        raise SequenceError(f"{path} is empty")
    return _VideoFile(path)


def _folder_reader(path: Path) -> _Reader:
    sequence = find_mot_folder(path)
    if sequence is None:
        return _ImageFolder(path, path.resolve().name, None)
    if sequence.images is None:
        raise SequenceError(
            f"{path} is a MOTChallenge sequence without images: it has no folder {sequence.info.images}"
        )
    return _ImageFolder(sequence.images, sequence.info.name, sequence.info.frame_rate)


class _Reader(ABC):
    """What delivers decoded images one by one; may be opened again after `close`."""

    live = False
    length: int | None = None
    frame_rate: float | None = None

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def open(self) -> None:
        """Go to the first image."""

    @abstractmethod
    def read(self) -> NDArray[Any] | None:
        """The next image as OpenCV has it; None at the end."""

    @abstractmethod
    def skip(self) -> bool:
        """Pass over the next image; False at the end."""

    @abstractmethod
    def close(self) -> None:
        """Let go of files."""

    def detail(self, position: int) -> str:
        """What else tells where an image is."""
        return ""


class _Capture(_Reader):
    """What OpenCV's VideoCapture decodes."""

    _capture: Any = None

    @abstractmethod
    def _start(self) -> Any:
        """An opened VideoCapture."""

    def open(self) -> None:
        if self._capture is not None:
            return
        # FFmpeg would tell the user's terminal of every damaged block.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(0)
        try:
            self._capture = self._start()
        finally:
            cv2.utils.logging.setLogLevel(level)
        rate, length = self._property(cv2.CAP_PROP_FPS), self._property(cv2.CAP_PROP_FRAME_COUNT)
        self.frame_rate = rate if _FRAME_RATES[0] <= rate <= _FRAME_RATES[1] else None
        self.length = int(length) if 1.0 <= length < 2**31 and not self.live else None

    def read(self) -> NDArray[Any] | None:
        for _ in range(_ATTEMPTS):
            delivered, image = self._tried(self._capture.read)
            if delivered and image is not None and image.size:
                return image
        return None

    def skip(self) -> bool:
        return any(self._tried(self._capture.grab) for _ in range(_ATTEMPTS))

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _tried(self, call: Any) -> Any:
        try:
            return call()
        except cv2.error as error:
            raise SequenceError(f"{self.name}: the decoder failed ({_reason(error)})") from error

    def _property(self, which: int) -> float:
        value = float(self._capture.get(which))
        return value if math.isfinite(value) else -1.0


class _VideoFile(_Capture):
    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path
        try:
            # OpenCV tells nothing of permissions.
            with path.open("rb"):
                pass
        except OSError as error:
            raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error

    def _start(self) -> Any:
        waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT]
        # First the backend whose behavior is known; where a platform lacks it, whichever there is.
        for backend, parameters in ((cv2.CAP_FFMPEG, waits), (cv2.CAP_ANY, [])):
            try:
                capture = cv2.VideoCapture(str(self.path), backend, parameters)
            except cv2.error:
                continue
            if capture.isOpened():
                return capture
        raise SequenceError(
            f"{self.path} cannot be decoded: it is no video, of an unknown format, or truncated "
            "(an mp4 that was not finished has no index)"
        )


class _Camera(_Capture):
    live = True

    def __init__(self, index: int) -> None:
        super().__init__(f"camera {index}")
        self._index = index

    def _start(self) -> Any:
        capture = cv2.VideoCapture(self._index) if 0 <= self._index < 2**31 else None
        if capture is None or not capture.isOpened():
            raise SequenceError(
                f"camera {self._index} cannot be opened; check that it is attached and that nothing else uses it"
            )
        return capture


class _ImageFolder(_Reader):
    def __init__(self, path: Path, name: str, frame_rate: float | None) -> None:
        super().__init__(name)
        try:
            names = [entry.name for entry in os.scandir(path) if entry.name.lower().endswith(IMAGE_SUFFIXES)]
        except OSError as error:
            raise SequenceError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
        if not names:
            raise SequenceError(f"{path} holds no images ({', '.join(IMAGE_SUFFIXES)})")
        self._path = path
        self._names = sorted(names, key=_natural)
        self._next = 0
        self.length, self.frame_rate = len(names), frame_rate

    def open(self) -> None:
        self._next = 0

    def read(self) -> NDArray[Any] | None:
        if self._next == len(self._names):
            return None
        file = self._path / self._names[self._next]
        try:
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise SequenceError(f"{file} cannot be decoded ({_reason(error)})") from error
        if image is None or image.size == 0:
            raise SequenceError(f"{file} is no image that can be decoded; mend it or take it out of the folder")
        self._next += 1
        return image

    def skip(self) -> bool:
        if self._next == len(self._names):
            return False
        self._next += 1
        return True

    def close(self) -> None:
        """Nothing is open between images."""

    def detail(self, position: int) -> str:
        return f" ({self._names[position]})"


def _rgb(image: NDArray[Any], where: str) -> Frame:
    """A decoded image as RGB, uint8, shape (H, W, 3)."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    channels = 1 if image.ndim == 2 else image.shape[2]
    codes = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    if image.dtype != np.uint8 or channels not in codes:
        raise SequenceError(
            f"{where}: images must have 8 or 16 bits and 1, 3 or 4 channels, got {image.dtype}, {channels} channel(s)"
        )
    return cv2.cvtColor(image, codes[channels])  # type: ignore[return-value]


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Key that puts frame 9 before frame 10, with or without leading zeros."""
    parts = re.split(r"([0-9]+)", name)
    return [(0, int(part), "") if part[:1].isdecimal() and part.isascii() else (1, 0, part) for part in parts if part]


def _reason(error: cv2.error) -> str:
    return " ".join(str(getattr(error, "err", "") or error).split())[:160]
