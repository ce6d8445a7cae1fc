"""Films, written frame by frame, whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.baselines.reporting.files import ResultsError, atomic_path, storage_error
from servotrack.baselines.reporting.h264 import H264Writer, has_h264
from servotrack.estimators.types import Image

CODECS = {".webm": "VP80", ".mp4": "mp4v", ".avi": "MJPG"}
"""Browsers play VP8 in WebM (VP9 takes seven times as long to write), and .mp4 if PyAV writes it as H.264, which is
quicker by far. OpenCV's wheels cannot write H.264; their mp4v plays in no browser."""

SIDES = (16, 8190)
"""Range of width and height of a film, px. Encoders write unreadable files or crash outside of it."""
RATES = (0.1, 1000.0)
"""Range of frame rates of a film, frames per second."""
_LEAST_SPACE = 4 << 20
"""Free disk space below which a film that fails is taken for one that a full disk cut off, bytes."""


def browser_suffix() -> str:
    """Return the suffix of the quickest film that browsers play: .mp4 with PyAV, else .webm."""
    return ".mp4" if has_h264() else ".webm"


class FilmError(ResultsError):
    """Film that cannot be written here."""


def check_film_path(path: Path) -> None:
    """Raises ValueError unless the path's suffix is one that can be written."""
    if path.suffix not in CODECS:
        raise ValueError(f"video must end in {', '.join(CODECS)}, got {str(path)!r}")


def write_film(frames: Iterable[Image], path: Path, rate: float) -> int:
    """Write RGB frames as a film, whole or not at all. An odd side gets its last row or column of pixels twice.

    Args:
        frames: RGB images of one size, uint8, shape (H, W, 3), sides from 16 to 8190 px.
        path: Ends in .webm, .mp4 or .avi.
        rate: Frames per second, from 0.1 to 1000.

    Returns:
        Number of frames.

    Raises:
        ValueError: Another suffix or rate, no frames, or a frame of another size or kind.
        FilmError: OpenCV cannot write this format or size here, or the written film cannot be read.
    """
    with Film(path, rate) as film:
        for frame in frames:
            film.write(frame)
        if film.count == 0:
            raise ValueError("frames must hold at least one frame, got none")
        film.check()
    return film.count


class Film:
    """Film that is written frame by frame, under a temporary name until the block around it ends well.

    Args:
        path: Ends in .webm, .mp4 or .avi. Without a frame nothing is written there.
        rate: Frames per second, from 0.1 to 1000.

    Attributes:
        count: Number of frames so far.

    Raises:
        ValueError: Another suffix or rate.
    """

    def __init__(self, path: Path, rate: float) -> None:
        check_film_path(path)
        # OpenCV never returns from an infinite rate.
        if not RATES[0] <= rate <= RATES[1]:
            raise ValueError(f"rate must lie in [{RATES[0]:g}, {RATES[1]:g}] frames per second, got {rate!r}")
        self.path, self._rate = path, float(rate)
        self.count = 0
        self._shape: tuple[int, ...] = ()
        self._writer: Any = None
        self._temporary = path
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Film:
        import cv2

        # Otherwise it tells the terminal of every frame that a full disk does not take.
        self._stack.callback(cv2.utils.logging.setLogLevel, cv2.utils.logging.getLogLevel())
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            self._release()
        finally:
            self._stack.__exit__(*error)

    def _release(self) -> None:
        if self._writer is None:
            return
        try:
            self._writer.release()
        except OSError as error:
            raise self._failed(f"{self.path} could not be finished ({error})") from error

    def write(self, frame: Image) -> None:
        """Append a frame.

        Args:
            frame: RGB image of the first one's size, uint8, shape (H, W, 3).

        Raises:
            ValueError: The frame has another size than the first one, or is not an RGB image.
            FilmError: OpenCV cannot write this format or size here.
        """
        import cv2

        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ValueError(f"frame {self.count} must be an RGB image, uint8, shape (H, W, 3), got {_kind(frame)}")
        if self._writer is None:
            self._shape = frame.shape
            self._writer = self._opened()
        if frame.shape != self._shape:
            raise ValueError(
                f"frame {self.count} has {frame.shape[1]}x{frame.shape[0]} px, the first one "
                f"{self._shape[1]}x{self._shape[0]}; draw all frames in one size"
            )
        # Codecs need even sides.
        below, right = frame.shape[0] % 2, frame.shape[1] % 2
        image: Any = frame
        if below or right:
            image = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
        try:
            self._writer.write(
                image if isinstance(self._writer, H264Writer) else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            )
        except OSError as error:
            raise self._failed(f"{self.path} could not be written ({error})") from error
        self.count += 1

    def check(self) -> None:
        """Finish the film and read it back, because OpenCV does not report a full disk. No frame can follow.

        Raises:
            FilmError: The film has another number of frames than were written.
            StorageError: The same, on a disk that is full.
        """
        import cv2

        self._release()
        found = 0
        with _hushed():
            reader = cv2.VideoCapture(str(self._temporary.absolute()))
            while found <= self.count and reader.grab():
                found += 1
            reader.release()
        if found != self.count:
            raise self._failed(
                f"{self.path} could not be written: {found} of {self.count} frames can be read back; "
                "check the free disk space, or choose another format"
            )

    def _opened(self) -> Any:
        import cv2

        suffix, (height, width) = self.path.suffix, self._shape[:2]
        if not all(SIDES[0] <= side <= SIDES[1] for side in (height, width)):
            raise FilmError(
                f"frames of {width}x{height} px cannot be filmed: sides must have {SIDES[0]} to {SIDES[1]} px; "
                "resize them"
            )
        self._temporary = self._stack.enter_context(atomic_path(self.path))
        size = (width + width % 2, height + height % 2)
        if suffix == ".mp4" and has_h264():
            return H264Writer(self._temporary, self._rate, size)
        with _hushed():
            # FFmpeg takes a relative path that begins as `file:` for an address.
            path = str(self._temporary.absolute())
            writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*CODECS[suffix]), self._rate, size)
        if not writer.isOpened():
            raise self._failed(f"this OpenCV cannot write {CODECS[suffix]} into {suffix}; try {', '.join(CODECS)}")
        return writer

    def _failed(self, message: str) -> ResultsError:
        """Return the error to raise. OpenCV gives no reason, but a full disk shows in the space that is left."""
        if shutil.disk_usage(self.path.parent).free < _LEAST_SPACE:
            return storage_error(self.path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        return FilmError(message)


def _kind(frame: object) -> str:
    return f"{frame.dtype}, shape {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Keep OpenCV from complaining past Python's streams: WebM has no tags for codecs, a film cut off has no index."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
