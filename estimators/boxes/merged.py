"""Blobs that cover several known people, taken apart before a tracker uses them."""

from __future__ import annotations

import numpy as np
from numba import njit

from servotrack.estimators.boxes.overlap import covered_boxes, covered_by
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.types import Array

COVERED = 0.6
"""Share of a predicted box inside a blob from which the person may be part of it."""

LARGER = 1.4
"""A blob this much wider or taller than a person holds more than this person."""

SOLID = 0.97
"""Detections whose area is more of their box than this are boxes of a detector of people, not blobs."""

SAME = 0.7
"""Of two predicted boxes that share this much of the smaller one, only one person can be seen in a blob."""

LARGEST_SHIFT = 0.25
"""Most that a blob's edge moves a predicted box, as a share of the box's size along that axis."""


def split_merged(detections: Detections, predicted: Array) -> Detections:
    """One detection per known person in place of each blob that covers several.

    Each person's share is the predicted box, moved so that the outermost of them touch the blob's edges. Its
    appearance is unknown (zeros). Only blobs are taken apart, that is, detections whose area is less than their box's:
    a detector of people means one person by each box.

    Args:
        detections: What a detector found.
        predicted: Boxes at which known people are expected. Shape (T, 4), px.

    Returns:
        The same object where no blob covers several people.
    """
    boxes = np.asarray(detections.boxes, dtype=np.float64)
    blob = detections.areas < SOLID * boxes[:, 2] * boxes[:, 3]
    if len(predicted) < 2 or not _may_cover_several(np.ascontiguousarray(boxes), blob, predicted):
        return detections
    predicted = _distinct(predicted)
    share = covered_by(predicted, boxes).T
    larger = (boxes[:, None, 2:] > LARGER * predicted[None, :, 2:]).any(axis=2)
    # A person belongs to one blob.
    inside = (share >= COVERED) & larger & blob[:, None] & (share == share.max(axis=0))
    several = np.flatnonzero(inside.sum(axis=1) >= 2)
    if len(several) == 0:
        return detections
    keep = np.flatnonzero(inside.sum(axis=1) < 2)
    sources = [(j, _shares_of(boxes[j], predicted[inside[j]])) for j in several.tolist()]
    parts = np.concatenate([part for _, part in sources])
    origin = np.concatenate([np.full(len(part), j) for j, part in sources])
    people = np.bincount(origin, minlength=len(boxes))[origin]
    return Detections(
        np.concatenate([boxes[keep], parts]),
        np.concatenate([detections.centroids[keep], parts[:, :2] + parts[:, 2:] / 2.0]),
        np.concatenate([detections.areas[keep], detections.areas[origin] / people]),
        np.concatenate([detections.confidences[keep], detections.confidences[origin]]),
        np.concatenate([detections.features[keep], np.zeros((len(parts), detections.features.shape[1]))]),
    )


@njit(cache=True, nogil=True)
def _may_cover_several(boxes, blob, predicted):  # type: ignore[no-untyped-def]
    """Whether any blob covers two people or more; in most frames none does, and nothing else need be looked at."""
    covered = covered_boxes(predicted, boxes)
    for j in range(len(boxes)):
        count = 0
        for k in range(len(predicted) if blob[j] else 0):
            larger = boxes[j, 2] > LARGER * predicted[k, 2] or boxes[j, 3] > LARGER * predicted[k, 3]
            if covered[k, j] >= COVERED and larger:
                count += 1
        if count >= 2:
            return True
    return False


def _distinct(people: Array) -> Array:
    """The boxes without those that hide behind an earlier one or repeat it."""
    share = covered_by(people, people)
    same = np.tril(np.maximum(share, share.T) >= SAME, -1)
    return people[~same.any(axis=1)] if same.any() else people


def _shares_of(blob: Array, people: Array) -> Array:
    """Predicted boxes inside one blob, moved by its edges. Shape (k, 4), px."""
    out = people.copy()
    for axis in (0, 1):
        low, high = people[:, axis], people[:, axis] + people[:, 2 + axis]
        first, last = int(np.argmin(low)), int(np.argmax(high))
        start, stop = blob[axis] - low[first], blob[axis] + blob[2 + axis] - high[last]
        shift = np.full(len(people), 0.5 * (start + stop))
        if first != last:
            shift[first], shift[last] = start, stop
        limit = LARGEST_SHIFT * people[:, 2 + axis]
        out[:, axis] += np.clip(shift, -limit, limit)
    return out
