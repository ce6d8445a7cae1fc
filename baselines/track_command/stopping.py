"""Ctrl-C and the end of the disk: what stops a long run, told between two frames so that nothing is left half done."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

_RESERVE = 4 << 20
_PER_FRAME = 64
"""Bytes that must stay free: for what encoders hold back, and for the film's index of some 50 bytes a frame."""
_EVERY = 8


class Interruption:
    """While its block runs, the first SIGINT or SIGTERM is only noted; the second one acts as ever.

    Attributes:
        signal: The number noted; 0 for none.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._before[number] = signal.signal(number, self._note)
            except ValueError:  # Only a main thread may listen.
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
    """Watches that the disk keeps room to finish what was begun: OpenCV does not tell that a film could not be written.

    Args:
        folder: Where is written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._frames = 0

    def check(self) -> None:
        """Call once for every frame.

        Raises:
            OSError: Less than what finishing takes is free.
        """
        if self._frames % _EVERY == 0:
            needed = _RESERVE + _PER_FRAME * self._frames
            free = shutil.disk_usage(self._folder).free
            if free < needed:
                raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} ({free >> 10} KiB free)", str(self._folder))
        self._frames += 1
