"""Tracks improved after the fact, in a file of their own: nobody could have reported them in time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.reporting.files import atomic_path
from servotrack.envs.track.files.mot_files import mot_row
from servotrack.envs.track.files.recorded import read_tracks
from servotrack.estimators.boxes.offline import fill_gaps
from servotrack.estimators.metrics.tracks import Track

OFFLINE_TRACKS = "tracks_offline.txt"
_LONGEST_GAP = 1.0
_SHORTEST_TRACK = 0.3
"""Of a gap that is filled and of a track that is kept, s."""


def write_offline(online: Path, frames: Sequence[int], frame_rate: float) -> Path:
    """Fill gaps of up to a second by straight lines, and drop tracks of less than 0.3 s.

    Args:
        online: The file of tracks as they were reported; the new one is written beside it.
        frames: The frames that were tracked, from 0, increasing.
        frame_rate: Of these, per second.

    Returns:
        The file written.
    """
    numbers = np.asarray(frames, dtype=np.int64)
    found = read_tracks(online)
    tracks = [Track(np.searchsorted(numbers, track.steps), track.states) for track in found.tracks]
    shortest = max(round(_SHORTEST_TRACK * frame_rate), 1)
    kept = [len(track.steps) >= shortest for track in tracks]
    filled = fill_gaps(tracks, round(_LONGEST_GAP * frame_rate), shortest)
    rows = [
        (int(numbers[step]) + 1, identity, box)
        for identity, track in zip(found.ids[kept].tolist(), filled, strict=True)
        for step, box in zip(track.steps.tolist(), track.states, strict=True)
    ]
    path = online.with_name(OFFLINE_TRACKS)
    with atomic_path(path) as temporary:
        temporary.write_text("".join(mot_row(*row) for row in sorted(rows, key=lambda row: row[:2])), encoding="ascii")
    return path
