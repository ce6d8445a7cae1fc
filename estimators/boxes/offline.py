"""Offline post-processing of tracks: fill gaps and drop short fragments. The result is not causal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servotrack.estimators.metrics.tracks import Track


def fill_gaps(tracks: Sequence[Track], longest: int, shortest: int = 1) -> list[Track]:
    """Fill the gaps of tracks by linear interpolation and drop very short tracks.

    Args:
        tracks: Tracks of boxes or other states.
        longest: Largest number of consecutive missing steps that are filled, at least 0.
        shortest: Tracks with fewer states are dropped, at least 1.

    Returns:
        New tracks, in the same order.

    Raises:
        ValueError: `longest` or `shortest` is out of range.
    """
    if longest < 0 or shortest < 1:
        raise ValueError(f"longest must be at least 0 and shortest at least 1, got {longest!r}, {shortest!r}")
    return [_filled(track, longest) for track in tracks if len(track.steps) >= shortest]


def _filled(track: Track, longest: int) -> Track:
    steps, states = np.asarray(track.steps, dtype=np.int64), np.asarray(track.states, dtype=np.float64)
    if len(steps) == 0:
        return Track(steps.copy(), states.copy())
    every = np.arange(steps[0], steps[-1] + 1)
    after = np.searchsorted(steps, every)
    wanted = (steps[after] == every) | (steps[after] - steps[np.maximum(after - 1, 0)] <= longest + 1)
    filled = np.stack([np.interp(every[wanted], steps, column) for column in states.T], axis=1)
    return Track(every[wanted], filled)
