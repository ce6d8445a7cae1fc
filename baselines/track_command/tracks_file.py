"""File of tracks in MOTChallenge format, written frame by frame."""

from __future__ import annotations

from servotrack.baselines.track_command.growing_file import GrowingFile
from servotrack.envs.track.files.mot_files import mot_row
from servotrack.estimators.rfs.sets import SetEstimate


class TracksFile(GrowingFile):
    """Tracks; a row is a box."""

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
        self.append("".join(rows), len(rows))
