"""Offline post-processing of tracks: gap filling and removal of fragments.

The result is written to a separate file because it is not causal.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.reporting.files import atomic_path
from servotrack.envs.track.files.mot_files import mot_row
from servotrack.envs.track.files.read import read_tracks
from servotrack.estimators.boxes.offline import fill_gaps
from servotrack.estimators.metrics.tracks import Track

OFFLINE_TRACKS = "tracks_offline.txt"
_LONGEST_GAP = 1.0
"""Longest gap that is filled, s."""
_SHORTEST_TRACK = 0.3
"""Shortest track that is kept, s."""


def write_offline(online: Path, frames: Sequence[int], frame_rate: float) -> Path:
    """Fill gaps of up to 1 s by linear interpolation, and drop tracks shorter than 0.3 s.

    Args:
        online: File of the tracks as reported. The new file is written into the same folder.
        frames: Numbers of the tracked frames, from 0, increasing.
        frame_rate: Tracked frames per second.

    Returns:
        Path of the new file.
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
