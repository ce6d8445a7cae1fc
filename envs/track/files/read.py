"""Reading of recorded tracks from a file of any supported format."""

from __future__ import annotations

from pathlib import Path

from servotrack.envs.track.files.bounded import is_folder
from servotrack.envs.track.files.caviar import read_caviar
from servotrack.envs.track.files.mot_files import read_mot_tracks
from servotrack.envs.track.files.recorded import RecordedTracks


def read_tracks(path: str | Path) -> RecordedTracks:
    """Read the tracks of a file. The suffix .xml selects CAVIAR's CVML, any other suffix MOTChallenge's text format.

    Args:
        path: File, or folder of a MOTChallenge sequence, whose gt/gt.txt is read.

    Returns:
        The tracks of all identities.

    Raises:
        SequenceError: If the file is missing, has another format or contains an invalid row.
    """
    file = Path(path)
    if is_folder(file):
        file = file / "gt" / "gt.txt"
    return read_caviar(file) if file.suffix.lower() == ".xml" else read_mot_tracks(file)
