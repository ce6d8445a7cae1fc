"""Scores of tracks in a bearing-time record: errors, starts and ends, crossings, and false tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.envs.track.sonar.scene import crossings
from servotrack.estimators.metrics import Track
from servotrack.estimators.types import Array, Labels, Mask

MATCH_DISTANCE = 3.0
"""Largest distance of a track from its target, deg."""
CROSSING_WINDOW = (2, 10)
"""Nearest and farthest record before and after a crossing that decide about kept or swapped tracks."""
_SMALLEST_PRESENCE = 2
"""Records with both targets on either side of a crossing, within `CROSSING_WINDOW`, that make the crossing count."""


class RecordScores(NamedTuple):
    """Scores of the tracks of one record with n targets.

    Attributes:
        squared_error: Sum of squared bearing errors over the records in which a target is tracked, shape (n,), deg^2.
        tracked: Number of records in which a target is tracked, shape (n,).
        present: Number of records in which a target exists, shape (n,).
        start: First tracked record minus the target's first record, shape (n,); NaN if it is never tracked.
        end: Last tracked record minus the target's last record, shape (n,); NaN if it is never tracked.
        crossings: Number of crossings that count.
        kept: Number of crossings in which both targets kept their track.
        swapped: Number of crossings in which a track changed to the other target.
        false_tracks: Number of tracks that match no target in more than half of their records.
        count_right: Share of records in which the number of tracks equals the number of targets.
    """

    squared_error: Array
    tracked: Labels
    present: Labels
    start: Array
    end: Array
    crossings: int
    kept: int
    swapped: int
    false_tracks: int
    count_right: float


def score_tracks(bearings: Array, exists: Mask, tracks: Sequence[Track]) -> RecordScores:
    """Score the tracks of one record.

    Args:
        bearings: True bearings, shape (T, n), deg.
        exists: Mask of existing targets, shape (T, n).
        tracks: Tracks with steps from 0 to T - 1 and bearings (k, 1), deg.
    """
    length, n = bearings.shape
    owner = np.full((length, n), -1)
    error = np.zeros((length, n))
    stacked = np.full((length, len(tracks)), np.nan)
    for number, track in enumerate(tracks):
        stacked[track.steps, number] = track.states[:, 0]
    for k in range(length):
        if n and tracks:
            apart = np.abs(bearings[k, :, None] - stacked[k])
            apart = np.where(exists[k, :, None] & (apart < MATCH_DISTANCE), apart, np.inf)
            owner[k] = _owners(apart, owner[max(k - 1, 0)])
            found = np.flatnonzero(owner[k] >= 0)
            error[k, found] = apart[found, owner[k, found]]
    tracked = owner >= 0
    start, end = np.full(n, np.nan), np.full(n, np.nan)
    for target in range(n):
        there, seen = np.flatnonzero(exists[:, target]), np.flatnonzero(tracked[:, target])
        if len(seen):
            start[target], end[target] = seen[0] - there[0], seen[-1] - there[-1]
    at_target = np.array([(owner == number).sum() for number in range(len(tracks))], dtype=np.int64)
    lengths = np.array([len(track.steps) for track in tracks], dtype=np.int64)
    verdicts = [_verdict(owner, exists, *crossing) for crossing in crossings(bearings, exists)]
    counted = [verdict for verdict in verdicts if verdict is not None]
    return RecordScores(
        squared_error=(error**2).sum(axis=0),
        tracked=tracked.sum(axis=0),
        present=exists.sum(axis=0),
        start=start,
        end=end,
        crossings=len(counted),
        kept=counted.count("kept"),
        swapped=counted.count("swapped"),
        false_tracks=int((2 * at_target < lengths).sum()),
        count_right=float(((~np.isnan(stacked)).sum(axis=1) == exists.sum(axis=1)).mean()),
    )


def _owners(apart: Array, before: Labels) -> Labels:
    """Track at each target, -1 without one: its previous track if near enough, else by assignment of the rest."""
    owner = np.full(len(apart), -1)
    for target in np.flatnonzero(before >= 0).tolist():
        if np.isfinite(apart[target, before[target]]):
            owner[target] = before[target]
    rest = np.flatnonzero(owner < 0)
    free = np.setdiff1d(np.arange(apart.shape[1]), owner)
    cost = np.minimum(apart[np.ix_(rest, free)], MATCH_DISTANCE)
    for i, j in zip(*linear_sum_assignment(cost), strict=True):
        if cost[i, j] < MATCH_DISTANCE:
            owner[rest[i]] = free[j]
    return owner


def _verdict(owner: Labels, exists: Mask, at: int, one: int, other: int) -> str | None:
    """Return "kept", "swapped" or "lost" for a crossing; None if a target exists too briefly."""
    near, far = CROSSING_WINDOW
    before, after = slice(max(at - far, 0), max(at - near, 0)), slice(at + near, at + far)
    both = exists[:, one] & exists[:, other]
    if min(both[before].sum(), both[after].sum()) < _SMALLEST_PRESENCE:
        return None
    a, b = _usual(owner[before, one]), _usual(owner[before, other])
    c, d = _usual(owner[after, one]), _usual(owner[after, other])
    if (a >= 0 and a == d) or (b >= 0 and b == c):
        return "swapped"
    return "kept" if a >= 0 and b >= 0 and (a, b) == (c, d) else "lost"


def _usual(owners: Labels) -> int:
    """Most frequent track of a target, -1 for none."""
    known = owners[owners >= 0]
    return int(np.bincount(known).argmax()) if len(known) else -1
