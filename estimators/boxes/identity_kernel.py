"""What `identities` does over and over for every identity, compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from servotrack.estimators.boxes.overlap import covered_boxes

LOOK_RATE = 0.1
"""Weight of a new frame in an identity's mean appearance."""

SPEED_RATE = 0.3
"""Weight of a new frame in an identity's velocity."""

APART = 0.05
"""Overlap below which two identities have parted."""

NEAR = 0.6
"""Distance (one minus overlap) up to which a detection is the one that a reported box comes from."""


@njit(cache=True, nogil=True)
def follow(inner, box, velocity, absent, labels, states):  # type: ignore[no-untyped-def]
    """Each identity's row among the reported labels, -1 for none, and its box, velocity and absence after them."""
    rows = np.full(len(inner), -1, np.int64)
    box, velocity, absent = box.copy(), velocity.copy(), absent + 1
    for k in range(len(inner)):
        for row in range(len(labels)):
            if labels[row] == inner[k]:
                rows[k] = row
        if rows[k] < 0:
            continue
        new = states[rows[k]]
        for axis in range(2):
            moved = (new[axis] + new[axis + 2] / 2.0) - (box[k, axis] + box[k, axis + 2] / 2.0)
            velocity[k, axis] += SPEED_RATE * (moved / absent[k] - velocity[k, axis])
        box[k] = new
        absent[k] = 0
    return rows, box, velocity, absent


@njit(cache=True, nogil=True)
def find_rivals(name, rival, box, here, merge_overlap):  # type: ignore[no-untyped-def]
    """With whom each identity is merged now, or was and has not parted: then the old rival stays."""
    out = rival.copy()
    covered = covered_boxes(box, box)
    for k in range(len(name)):
        if not here[k] or rival[k] != 0:
            continue
        overlap = 0.0
        for other in range(len(name)):
            share = max(covered[k, other], covered[other, k])
            if other != k and here[other] and share > overlap:
                overlap = share
                if overlap >= merge_overlap:
                    out[k] = name[other]
    return out


@njit(cache=True, nogil=True)
def mix_looks(known, look, rows, seen, rival):  # type: ignore[no-untyped-def]
    """Mean appearances after a frame; while two are merged neither's appearance is its own, and none is learned."""
    out = known.copy()
    for k in range(len(known)):
        if rows[k] < 0 or rival[k] != 0 or not seen[rows[k]]:
            continue
        rate = LOOK_RATE if known[k].any() else 1.0
        total = 0.0
        for c in range(known.shape[1]):
            out[k, c] = (1.0 - rate) * known[k, c] + rate * look[rows[k], c]
            total += out[k, c] * out[k, c]
        out[k] /= max(math.sqrt(total), 1e-12)
    return out


@njit(cache=True, nogil=True)
def own_looks(distance, features):  # type: ignore[no-untyped-def]
    """Of each box, by its distances to detections: the nearest one's appearance, if it is near and nobody else's."""
    best, users = np.zeros(len(distance), np.int64), np.zeros(len(features), np.int64)
    seen, out = np.zeros(len(distance), np.bool_), np.zeros((len(distance), features.shape[1]))
    for k in range(len(distance)):
        best[k] = distance[k].argmin()
        seen[k] = distance[k, best[k]] <= NEAR
        users[best[k]] += seen[k]
    for k in range(len(distance)):
        # A detection that two boxes share is a merged blob: nobody's appearance.
        seen[k] = seen[k] and users[best[k]] == 1 and features[best[k]].any()
        if seen[k]:
            out[k] = features[best[k]]
    return out, seen


@njit(cache=True, nogil=True)
def any_parted(name, inner, rival, box, labels, seen):  # type: ignore[no-untyped-def]
    """Whether any identity's rival is gone, or both are seen and do not overlap any more."""
    clear = np.zeros(len(name), np.bool_)
    for k in range(len(name)):
        for row in range(len(labels)):
            if labels[row] == inner[k]:
                clear[k] = seen[row]
    for k in range(len(name)):
        if rival[k] <= 0:
            continue
        gone = True
        for other in range(len(name)):
            if name[other] == rival[k]:
                covered = covered_boxes(box[k : k + 1], box[other : other + 1])[0, 0]
                covers = covered_boxes(box[other : other + 1], box[k : k + 1])[0, 0]
                gone = clear[k] and clear[other] and max(covered, covers) <= APART
        if gone:
            return True
    return False


@njit(cache=True, nogil=True)
def look_up(keys, known, values, missing):  # type: ignore[no-untyped-def]
    """The value beside each key, the last one where a key is there twice."""
    out = np.full(len(keys), missing, values.dtype)
    for k in range(len(keys)):
        for row in range(len(known)):
            if known[row] == keys[k]:
                out[k] = values[row]
    return out
