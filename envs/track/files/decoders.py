"""Decoders of video files, cameras and image folders, with one interface."""

from __future__ import annotations

import contextlib
import math
import os
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.containers import DEMUXERS, check_container
from servotrack.envs.track.files.images import MAX_SIDE, decode_image, quiet, reason, too_large
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.envs.track.files.recorded import FRAME_RATES, SequenceError

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
_ATTEMPTS = 5
"""Number of failed reads in a row after which a sequence has ended."""
_TIMEOUT = 10_000
"""Time-out of OpenCV for opening a file or reading a frame, ms."""
_CAPTURE_OPTIONS = f"format_whitelist;{','.join(DEMUXERS)}|protocol_whitelist;file|enable_drefs;0"
"""FFmpeg's options for files: no format that names other files, no data in other files, no network."""
_OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_ENVIRONMENT_LOCK = threading.Lock()


def find_decoder(source: str | Path | int) -> Decoder:
    """Return the unopened decoder for a source: the index of a camera, a folder, or a file.

    Raises:
        SequenceError: If the source does not exist or is empty.
    """
    if isinstance(source, bool):
        raise SequenceError(f"source must be a path or a camera's index, got {source!r}")
    if isinstance(source, (int, np.integer)):
        return Camera(int(source))
    text, path = str(source), Path(source)
    if not text:
        raise SequenceError("source is empty: give a video file, an image folder or a camera's index")
    try:
        folder, there = path.is_dir(), path.exists()
    except (OSError, ValueError) as error:
        raise SequenceError(f"source {text!r} cannot be a path ({error})") from error
    if folder:
        return _folder_decoder(path)
    if not there and text.isascii() and text.isdigit():
        return Camera(int(text))
    if not there:
        raise SequenceError(f"source {text!r} does not exist: give a video file, an image folder or a camera's index")
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
    """Source of decoded images, one by one. It can be opened again after `close`.

    Attributes:
        name: Name for titles and messages.
        live: True if the source cannot restart.
        length: Number of images that the source claims, once open; None if unknown.
        frame_rate: Frames per second, once open; None if unknown.
    """

    live = False
    length: int | None = None
    frame_rate: float | None = None

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def open(self) -> None:
        """Open the source at the first image."""

    @abstractmethod
    def read(self) -> NDArray[Any] | None:
        """Return the next image in OpenCV's format; None at the end."""

    @abstractmethod
    def skip(self) -> bool:
        """Skip the next image. Return False at the end."""

    @abstractmethod
    def close(self) -> None:
        """Close files."""

    def detail(self, position: int) -> str:
        """Return additional text for messages about an image, e.g. its file name."""
        return ""


@contextlib.contextmanager
def _one_file_only() -> Iterator[None]:
    """Keep FFmpeg from opening other files than the given one; OpenCV takes its options from the environment."""
    with _ENVIRONMENT_LOCK:
        before = os.environ.get(_OPTIONS_VARIABLE)
        # The user's options stay; of two values of an option the last one counts.
        os.environ[_OPTIONS_VARIABLE] = f"{before}|{_CAPTURE_OPTIONS}" if before else _CAPTURE_OPTIONS
        try:
            yield
        finally:
            if before is None:
                del os.environ[_OPTIONS_VARIABLE]
            else:
                os.environ[_OPTIONS_VARIABLE] = before


class Capture(Decoder):
    """Decoder based on OpenCV's VideoCapture."""

    _capture: Any = None

    @abstractmethod
    def _start(self) -> Any:
        """Return an opened VideoCapture."""

    def open(self) -> None:
        """Open at the first image; do nothing if already open."""
        if self._capture is not None:
            return
        # Otherwise FFmpeg prints every damaged block on the terminal.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        with quiet():
            self._capture = self._start()
        rate, length = self._property(cv2.CAP_PROP_FPS), self._property(cv2.CAP_PROP_FRAME_COUNT)
        # Other rates are errors of the header.
        self.frame_rate = rate if FRAME_RATES[0] <= rate <= FRAME_RATES[1] else None
        self.length = int(length) if 1.0 <= length < 2**31 and not self.live else None

    def read(self) -> NDArray[Any] | None:
        """Return the next image, after up to `_ATTEMPTS` reads; None at the end."""
        for _ in range(_ATTEMPTS):
            delivered, image = self._tried(self._capture.read)
            if delivered and image is not None and image.size:
                return image
        return None

    def skip(self) -> bool:
        """Skip an image without converting it. Return False at the end."""
        return any(self._tried(self._capture.grab) for _ in range(_ATTEMPTS))

    def close(self) -> None:
        """Close the file or camera."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _tried(self, call: Any) -> Any:
        try:
            return call()
        except cv2.error as error:
            raise SequenceError(f"{self.name}: the decoder failed ({reason(error)})") from error

    def _property(self, which: int) -> float:
        value = float(self._capture.get(which))
        return value if math.isfinite(value) else -1.0


class VideoFile(Capture):
    """A video file."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path

    def _start(self) -> Any:
        check_container(self.path)
        for backend, parameters in _file_backends():
            try:
                with _one_file_only():
                    # FFmpeg takes a relative path that begins as `file:` or `concat:` for an address.
                    capture = cv2.VideoCapture(str(self.path.absolute()), backend, parameters)
            except cv2.error:
                continue
            if capture.isOpened():
                return self._checked(capture)
        raise SequenceError(
            f"{self.path} cannot be decoded: an unknown codec, damaged, or truncated "
            "(an unfinished mp4 file has no index)"
        )

    def _checked(self, capture: Any) -> Any:
        """Return the capture if its frames are not too large."""
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if max(width, height) > MAX_SIDE:
            capture.release()
            raise SequenceError(too_large(str(self.path), int(width), int(height)))
        return capture


def _file_backends() -> list[tuple[int, list[int]]]:
    """Return OpenCV's backends for files, with parameters: FFmpeg, whose behavior is known, or all if it is missing."""
    if cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG):
        return [(cv2.CAP_FFMPEG, [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT])]
    # The backend for images would take a digit in the name for a counter, and open the file's neighbors.
    return [(backend, []) for backend in cv2.videoio_registry.getStreamBackends() if backend != cv2.CAP_IMAGES]


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
                f"camera {self._index} cannot be opened; check that it is attached and not used by another program"
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
        """Start at the first image."""
        self._next = 0

    def read(self) -> NDArray[Any] | None:
        """Return the next image; None at the end."""
        if self._next == len(self._names):
            return None
        file = self._path / self._names[self._next]
        image = decode_image(file)
        self._next += 1
        return image

    def skip(self) -> bool:
        """Skip an image without opening it. Return False at the end."""
        if self._next == len(self._names):
            return False
        self._next += 1
        return True

    def close(self) -> None:
        """Do nothing: no file stays open between images."""

    def detail(self, position: int) -> str:
        """Return the file name of an image."""
        return f" ({self._names[position]})"


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Key that puts frame 9 before frame 10, with or without leading zeros."""
    parts = re.split(r"([0-9]+)", name)
    return [(0, int(part), "") if part[:1].isdecimal() and part.isascii() else (1, 0, part) for part in parts if part]
