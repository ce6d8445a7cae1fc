"""A file that grows frame by frame. It is valid however the run ends."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.running import unfinished

UNFINISHED = ".unfinished"
_Self = TypeVar("_Self", bound="GrowingFile")


class GrowingFile:
    """Context that writes under a temporary name, and renames the file when the block ends.

    If the block ends by an error, what was appended before it is kept. If that is nothing, an earlier file stays.

    Args:
        path: Path of the file. Until the block ends, `.unfinished` is appended to its name.

    Attributes:
        rows: Number of rows written so far.

    Raises:
        ResultsError: The folder cannot be created or written.
    """

    def __init__(self, path: Path) -> None:
        ResultsFolder(path.parent).check_writable()
        self.path = path
        self.rows = 0
        self._growing = path.with_name(path.name + UNFINISHED)
        self._good = 0
        unfinished.begin(self._growing)
        # Unbuffered, so that a failed write is raised at once, in the frame that it belongs to.
        self._file = self._growing.open("wb", buffering=0)

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            # Cut off a frame that was written in part; this needs no disk space.
            os.ftruncate(self._file.fileno(), self._good)
        finally:
            self._file.close()
        if error[0] is not None and self.rows == 0:
            self._growing.unlink()
        else:
            self._growing.replace(self.path)
        unfinished.end(self._growing)

    def append(self, content: str, rows: int) -> None:
        """Append one frame's rows.

        Args:
            content: Whole lines.
            rows: Number of rows in them.

        Raises:
            OSError: The disk is full, or a file size limit is reached.
        """
        left = content.encode("utf-8")
        while left:
            left = left[self._file.write(left) :]
        if rows and not self.rows:
            # Valid after every frame from now on, so a command that ends by force keeps it.
            unfinished.begin(self._growing, keep_as=self.path)
        self.rows += rows
        self._good = self._file.tell()
