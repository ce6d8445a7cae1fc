"""Compiled kernels of `identities`."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.boxes.overlap import covered_boxes
from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def follow(inner, box, velocity, absent, labels, states, velocity_rate):  # type: ignore[no-untyped-def]
    """Row of each identity among the reported labels, -1 for none, and its new box, velocity and absence."""
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
            velocity[k, axis] += velocity_rate * (moved / absent[k] - velocity[k, axis])
        box[k] = new
        absent[k] = 0
    return rows, box, velocity, absent


@njit(cache=True, nogil=True)
def find_rivals(name, rival, box, here, merge_overlap):  # type: ignore[no-untyped-def]
    """Name of the identity that each one is merged with; an earlier rival stays until the two have separated."""
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
def mix_appearances(known, appearance, rows, seen, rival, rate_of_known):  # type: ignore[no-untyped-def]
    """Mean appearances after a frame; those of merged identities stay as they are."""
    out = known.copy()
    for k in range(len(known)):
        if rows[k] < 0 or rival[k] != 0 or not seen[rows[k]]:
            continue
        rate = rate_of_known if known[k].any() else 1.0
        total = 0.0
        for c in range(known.shape[1]):
            out[k, c] = (1.0 - rate) * known[k, c] + rate * appearance[rows[k], c]
            total += out[k, c] * out[k, c]
        out[k] /= max(math.sqrt(total), 1e-12)
    return out


@njit(cache=True, nogil=True)
def own_appearances(distance, features, match_distance):  # type: ignore[no-untyped-def]
    """Appearance of each box's nearest detection, and the mask of boxes with one that is near and not shared.

    Args:
        distance: Distance of each box to each detection, one minus overlap. Shape (k, Z).
        features: Appearance vectors of the detections. Shape (Z, F).
        match_distance: Largest distance of a box to its detection.
    """
    best, users = np.zeros(len(distance), np.int64), np.zeros(len(features), np.int64)
    seen, out = np.zeros(len(distance), np.bool_), np.zeros((len(distance), features.shape[1]))
    for k in range(len(distance)):
        best[k] = distance[k].argmin()
        seen[k] = distance[k, best[k]] <= match_distance
        users[best[k]] += seen[k]
    for k in range(len(distance)):
        # A detection that two boxes share is a merged blob, whose appearance belongs to neither.
        seen[k] = seen[k] and users[best[k]] == 1 and features[best[k]].any()
        if seen[k]:
            out[k] = features[best[k]]
    return out, seen


@njit(cache=True, nogil=True)
def any_parted(name, inner, rival, box, labels, seen, parted_overlap):  # type: ignore[no-untyped-def]
    """Return True if any identity's rival has ended, or both are seen and no longer overlap."""
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
                gone = clear[k] and clear[other] and max(covered, covers) <= parted_overlap
        if gone:
            return True
    return False


@njit(cache=True, nogil=True)
def look_up(keys, known, values, missing):  # type: ignore[no-untyped-def]
    """Value of each key; the last one if a key occurs twice, `missing` if it does not occur."""
    out = np.full(len(keys), missing, values.dtype)
    for k in range(len(keys)):
        for row in range(len(known)):
            if known[row] == keys[k]:
                out[k] = values[row]
    return out
