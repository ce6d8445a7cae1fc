"""Ignored targets: ground truth that is present but not scored, for example occluded people.

MOTChallenge treats its ignore regions in the same way.
"""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.types import Array, Mask

IGNORE_REACH = 0.5
"""Largest distance between an ignored target and its answer, fractions of the cut-off; for boxes, an IoU of 0.5."""


def ignored_answers(distances: Array, counted: Mask, hidden: Mask, reported: Mask, cutoff: float) -> Mask:
    """Return the mask of answers that are not scored because they match an ignored target.

    Scored targets come first: answers that the optimal assignment gives to them are kept. Each ignored target then
    removes at most one of the remaining answers, if it lies within `IGNORE_REACH` times the cut-off. Such an answer
    would otherwise count as a false target.

    Args:
        distances: Distances between true targets and answers, shape (N, n, k).
        counted: True targets that are scored, shape (N, n).
        hidden: True targets that are present but ignored, shape (N, n).
        reported: Reported answers, shape (N, k).
        cutoff: Distance from which an answer cannot be assigned to a target.

    Returns:
        Mask of the ignored answers, shape (N, k).
    """
    out = np.zeros(reported.shape, np.bool_)
    for row in np.flatnonzero(hidden.any(axis=1)).tolist():
        _mark_ignored(distances[row], counted[row], hidden[row], reported[row], cutoff, IGNORE_REACH * cutoff, out[row])
    return out


@njit(cache=True, nogil=True)
def _mark_ignored(distances, counted, hidden, reported, cutoff, reach, out):  # type: ignore[no-untyped-def]
    """Fill `out`, the mask of ignored answers, for one scene."""
    left = reported.copy()
    for kind in range(2):
        members = np.flatnonzero(counted) if kind == 0 else np.flatnonzero(hidden)
        answers = np.flatnonzero(left)
        limit = cutoff if kind == 0 else reach
        low, high = min(len(members), len(answers)), max(len(members), len(answers))
        if low == 0:
            continue
        cost = np.empty((low, high))
        for a in range(len(members)):
            for b in range(len(answers)):
                cut = min(distances[members[a], answers[b]], limit)
                if len(members) <= len(answers):
                    cost[a, b] = cut
                else:
                    cost[b, a] = cut
        chosen = assign(cost, low, high)
        for a in range(low):
            if cost[a, chosen[a]] < limit:
                answer = answers[chosen[a]] if len(members) <= len(answers) else answers[a]
                left[answer] = False
                if kind == 1:
                    out[answer] = True
