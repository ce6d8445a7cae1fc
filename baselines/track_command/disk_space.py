"""Check the free disk space between two frames, so that output files stay valid."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

_RESERVE = 4 << 20
"""Free disk space for data that encoders still buffer, bytes."""
_PER_FRAME = 64
"""Free disk space for the video's index, about 50 bytes per frame, bytes."""
_CHECK_INTERVAL = 8
"""Frames between two checks of the free disk space."""


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
