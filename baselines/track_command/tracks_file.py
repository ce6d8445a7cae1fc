"""File of tracks in MOTChallenge format, written frame by frame. It is valid however the run ends."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.running import unfinished
from servotrack.envs.track.files.mot_files import mot_row
from servotrack.estimators.rfs.sets import SetEstimate

UNFINISHED = ".unfinished"


class TracksFile:
    """Context that writes tracks under a temporary name, and renames the file when the block ends.

    If the block ends by an error, the frames before it are kept. If there are none, an earlier file stays.

    Args:
        path: Path of the file. Until the block ends, `.unfinished` is appended to its name.

    Attributes:
        rows: Number of boxes written so far.

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

    def __enter__(self) -> TracksFile:
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

    def write(self, frame: int, estimate: SetEstimate) -> None:
        """Append one frame's tracks.

        Args:
            frame: Frame number, from 1.
            estimate: Boxes in the source's px.

        Raises:
            OSError: The disk is full, or a file size limit is reached.
        """
        rows = [
            mot_row(frame, label, box, existence)
            for label, box, existence in zip(
                estimate.labels.tolist(), estimate.states, estimate.existence.tolist(), strict=True
            )
        ]
        content = "".join(rows).encode("ascii")
        while content:
            content = content[self._file.write(content) :]
        if rows and not self.rows:
            # Valid after every frame from now on, so a command that ends by force keeps it.
            unfinished.begin(self._growing, keep_as=self.path)
        self.rows += len(rows)
        self._good = self._file.tell()
