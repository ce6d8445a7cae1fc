"""Films, written frame by frame, whole or not at all."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from servotrack.baselines.reporting.files import atomic_path
from servotrack.estimators.types import Image

CODECS = {".webm": "VP80", ".mp4": "mp4v", ".avi": "MJPG"}
"""Browsers play VP8 in WebM (VP9 takes four times as long to write); OpenCV's wheels cannot write H.264."""


class FilmError(RuntimeError):
    """A film that cannot be written here."""


def check_film_path(path: Path) -> None:
    """Raises ValueError unless the path's suffix is one that can be written."""
    if path.suffix not in CODECS:
        raise ValueError(f"video must end in {', '.join(CODECS)}, got {str(path)!r}")


def write_film(frames: Iterator[Image], path: Path, rate: float) -> int:
    """Write RGB frames.

    Args:
        frames: All of one size, shape (H, W, 3).
        path: Ends in .webm, .mp4 or .avi.
        rate: Frames per second.

    Returns:
        Number of frames.

    Raises:
        ValueError: Another suffix, or no frames.
        FilmError: OpenCV cannot write this format here.
    """
    with Film(path, rate) as film:
        for frame in frames:
            film.write(frame)
        if film.count == 0:
            raise ValueError("frames must hold at least one frame, got none")
    return film.count


class Film:
    """A film that is written frame by frame, under a temporary name until the block around it ends well.

    Args:
        path: Ends in .webm, .mp4 or .avi. Nothing is written there where there was no frame.
        rate: Frames per second.

    Attributes:
        count: Frames so far.

    Raises:
        ValueError: Another suffix.
    """

    def __init__(self, path: Path, rate: float) -> None:
        check_film_path(path)
        self.path, self._rate = path, rate
        self.count = 0
        self._size = (0, 0)
        self._writer: Any = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Film:
        import cv2

        # Otherwise it tells the terminal of every frame that a full disk does not take.
        self._stack.callback(cv2.utils.logging.setLogLevel, cv2.utils.logging.getLogLevel())
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        return self

    def __exit__(self, *error: Any) -> None:
        if self._writer is not None:
            self._writer.release()
        self._stack.__exit__(*error)

    def write(self, frame: Image) -> None:
        """Append a frame.

        Args:
            frame: RGB, of the first one's size. Shape (H, W, 3).

        Raises:
            FilmError: OpenCV cannot write this format here.
        """
        import cv2

        if self._writer is None:
            # Codecs want even sides.
            height, width = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
            self._size = (width, height)
            self._writer = self._opened()
        width, height = self._size
        self._writer.write(cv2.cvtColor(frame[:height, :width], cv2.COLOR_RGB2BGR))
        self.count += 1

    def _opened(self) -> Any:
        import cv2

        temporary = self._stack.enter_context(atomic_path(self.path))
        suffix = self.path.suffix
        with _hushed():
            writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*CODECS[suffix]), self._rate, self._size)
        if not writer.isOpened():
            raise FilmError(f"this OpenCV cannot write {CODECS[suffix]} into {suffix}; try {', '.join(CODECS)}")
        return writer


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Keep OpenCV from complaining, past Python's streams, that WebM has no tags for codecs: it writes all the same."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
