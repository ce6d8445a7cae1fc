"""Stop a long run on SIGINT, SIGTERM or a full disk, between two frames, so that output files stay valid."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

_RESERVE = 4 << 20
"""Free disk space for data that encoders still buffer, bytes."""
_PER_FRAME = 64
"""Free disk space for the video's index, about 50 bytes per frame, bytes."""
_CHECK_INTERVAL = 8
"""Frames between two checks of the free disk space."""


class Interruption:
    """Context in which the first SIGINT or SIGTERM is only recorded. A second one acts as usual.

    Attributes:
        signal: Number of the recorded signal; 0 for none.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._before[number] = signal.signal(number, self._note)
            except ValueError:  # Only the main thread may set handlers.
                break
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()

    def _restore(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())


class SpaceGuard:
    """Check that the disk keeps enough space to finish the files. OpenCV reports no error if a video cannot be written.

    Args:
        folder: Folder of the output files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._frames = 0

    def check(self) -> None:
        """Check the free disk space; call once per frame.

        Raises:
            OSError: Too little space is left to finish the files.
        """
        if self._frames % _CHECK_INTERVAL == 0:
            needed = _RESERVE + _PER_FRAME * self._frames
            free = shutil.disk_usage(self._folder).free
            if free < needed:
                raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} ({free >> 10} KiB free)", str(self._folder))
        self._frames += 1
