"""Decoders of single images: a video file, a camera, a folder of images, each behind the same few calls."""

from __future__ import annotations

import contextlib
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

from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Image

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
_ATTEMPTS = 5
"""Times in a row that a decoder may deliver nothing before the sequence counts as over."""
_TIMEOUT = 10_000
"""Longest wait of OpenCV for a frame, ms."""
_FRAME_RATES = (0.1, 1000.0)
"""Frame rates outside are a container's slip, per second."""


def find_decoder(source: str | Path | int) -> Decoder:
    """The decoder for a source: a camera's index, a folder, or a file; it is not opened yet.

    Raises:
        SequenceError: Nothing there, or nothing in it.
    """
    if isinstance(source, bool):
        raise SequenceError(f"source must be a path or a camera's index, got {source!r}")
    if isinstance(source, (int, np.integer)):
        return Camera(int(source))
    text, path = str(source), Path(source)
    try:
        folder, there = path.is_dir(), path.is_file()
    except (OSError, ValueError) as error:
        raise SequenceError(f"source {text!r} cannot be a path ({error})") from error
    if folder:
        return _folder_decoder(path)
    if not there and text.isascii() and text.isdigit():
        return Camera(int(text))
    if not there:
        raise SequenceError(f"source {text!r} does not exist: give a video file, an image folder or a camera's index")
    if path.stat().st_size == 0:
        raise SequenceError(f"{path} is empty")
    return VideoFile(path)


def _folder_decoder(path: Path) -> Decoder:
    sequence = find_mot_folder(path)
    if sequence is None:
        return ImageFolder(path, path.resolve().name, None)
    if sequence.images is None:
        raise SequenceError(
            f"{path} is a MOTChallenge sequence without images: it has no folder {sequence.info.images}"
        )
    return ImageFolder(sequence.images, sequence.info.name, sequence.info.frame_rate)


class Decoder(ABC):
    """What delivers decoded images one by one; may be opened again after `close`.

    Attributes:
        name: For titles and messages.
        live: Whether it cannot start anew.
        length: Claimed number of images, once open; None where nothing is claimed.
        frame_rate: Per second, once open; None where nothing is told.
    """

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


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps OpenCV from writing to the user's terminal what an error of ours will say."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


class Capture(Decoder):
    """What OpenCV's VideoCapture decodes."""

    _capture: Any = None

    @abstractmethod
    def _start(self) -> Any:
        """An opened VideoCapture."""

    def open(self) -> None:
        """Start at the first image; one that is open goes on."""
        if self._capture is not None:
            return
        # FFmpeg would tell the user's terminal of every damaged block.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        with _quiet():
            self._capture = self._start()
        rate, length = self._property(cv2.CAP_PROP_FPS), self._property(cv2.CAP_PROP_FRAME_COUNT)
        self.frame_rate = rate if _FRAME_RATES[0] <= rate <= _FRAME_RATES[1] else None
        self.length = int(length) if 1.0 <= length < 2**31 and not self.live else None

    def read(self) -> NDArray[Any] | None:
        """The next image; waits out a few times that nothing comes."""
        for _ in range(_ATTEMPTS):
            delivered, image = self._tried(self._capture.read)
            if delivered and image is not None and image.size:
                return image
        return None

    def skip(self) -> bool:
        """Pass over an image without decoding its colors."""
        return any(self._tried(self._capture.grab) for _ in range(_ATTEMPTS))

    def close(self) -> None:
        """Let go of the file or camera."""
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


class VideoFile(Capture):
    """A video file."""

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


class Camera(Capture):
    """A camera that is attached to this machine."""

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


class ImageFolder(Decoder):
    """A folder of images, in the order of the numbers in their names."""

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
        """Go to the first image."""
        self._next = 0

    def read(self) -> NDArray[Any] | None:
        """The next image."""
        if self._next == len(self._names):
            return None
        file = self._path / self._names[self._next]
        try:
            with _quiet():
                image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise SequenceError(f"{file} cannot be decoded ({_reason(error)})") from error
        if image is None or image.size == 0:
            raise SequenceError(f"{file} is no image that can be decoded; mend it or take it out of the folder")
        self._next += 1
        return image

    def skip(self) -> bool:
        """Pass over an image without opening it."""
        if self._next == len(self._names):
            return False
        self._next += 1
        return True

    def close(self) -> None:
        """Nothing is open between images."""

    def detail(self, position: int) -> str:
        """The file's name."""
        return f" ({self._names[position]})"


def to_rgb(image: NDArray[Any], where: str) -> Image:
    """A decoded image as RGB, uint8, shape (H, W, 3).

    Args:
        image: As OpenCV has it: gray, BGR or BGRA, of 8 or 16 bits, of which the high byte counts.
        where: For the message.

    Raises:
        SequenceError: Any other image.
    """
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
