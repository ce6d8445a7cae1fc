"""Answers at members of the truth that are there but do not count, as people whom others hide."""

from __future__ import annotations

import numpy as np
from numba import njit

from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.types import Array, Mask

IGNORE_REACH = 0.5
"""Share of the cut-off within which an answer is one at a hidden member; of boxes, an IoU of one half."""


def ignored_answers(distances: Array, counted: Mask, hidden: Mask, reported: Mask, cutoff: float) -> Mask:
    """Which answers are left out because they are at somebody who does not count.

    Those who count come first: what the best assignment gives to them stays. Each hidden member then excuses at most
    one of the answers left over, which would be false otherwise, if it lies within `IGNORE_REACH` of the cut-off.

    Args:
        distances: Between truths and answers, shape (N, n, k).
        counted: Truths that count, shape (N, n).
        hidden: Truths that are there but do not count, shape (N, n).
        reported: Answers, shape (N, k).
        cutoff: Distance from which an answer has nothing to do with a truth.

    Returns:
        Shape (N, k).
    """
    out = np.zeros(reported.shape, np.bool_)
    for row in np.flatnonzero(hidden.any(axis=1)).tolist():
        _mark_ignored(distances[row], counted[row], hidden[row], reported[row], cutoff, IGNORE_REACH * cutoff, out[row])
    return out


@njit(cache=True, nogil=True)
def _mark_ignored(distances, counted, hidden, reported, cutoff, reach, out):  # type: ignore[no-untyped-def]
    """Fill `out` of one scene."""
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
