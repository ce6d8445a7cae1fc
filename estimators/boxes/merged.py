"""Split blobs that cover several known people before a tracker uses them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.overlap import covered_boxes, covered_by
from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.types import Array


class SplitRules(NamedTuple):
    """Conditions under which `split_merged` splits a blob.

    Attributes:
        covered: Smallest share of a predicted box inside a blob for the person to be part of it. Raising it splits
            fewer blobs.
        larger: Ratio of a blob's width or height to a person's from which the blob holds more than this person.
            Raising it splits fewer blobs.
        least: Smallest height of a person in a blob, heights of the blob; shorter ones are fragments. Raising it splits
            fewer blobs.
        tall: Smallest height of the tallest person in a blob, heights of the blob: below it a blob of a person's height
            is one person, whose parts were taken for several. Raising it splits fewer blobs.
        excess: Deviation of a blob's height from that of a person at its place, standard deviations, from which it is
            more than one person in any case. Raising it splits fewer blobs of people one above the other.
        solid: Largest ratio of a blob's area to its box's. Detections of a larger ratio are boxes of a person detector
            and never split.
        duplicate: Overlap of two predicted boxes, as a share of the smaller one, from which they count as one person.
            Raising it gives more parts.
        largest_shift: Largest shift of a predicted box toward a blob's edge, as a share of the box's size along that
            axis.
    """

    covered: float = 0.6
    larger: float = 1.4
    least: float = 0.4
    tall: float = 0.75
    excess: float = 2.0
    solid: float = 0.97
    duplicate: float = 0.7
    largest_shift: float = 0.25


def split_merged(
    detections: Detections, predicted: Array, rules: SplitRules | None = None, deviation: Array | None = None
) -> Detections:
    """Replace each blob that covers several known people by one detection per person.

    The parts of one person also become one blob. Divided by their boxes, it would confirm each of them, whatever its
    size, and the next frame would be divided again. So a blob that may be one person is divided only if one of the
    known people is nearly as tall as the blob is.

    The part of a person is the predicted box, moved so that the outermost boxes touch the blob's edges. Its appearance
    is unknown (zeros). Only blobs are split, that is, detections whose area is less than that of their box: a box of
    a person detector stands for one person.

    Args:
        detections: Detections of one frame.
        predicted: Boxes at which known people are expected. Shape (T, 4), px.
        rules: Conditions of a split; None for the defaults.
        deviation: Deviation of each detection's height from that of a person at its place, standard deviations; None if
            unknown. Shape (Z,).

    Returns:
        New detections, or the same object if no blob covers several people.
    """
    rules = rules or SplitRules()
    boxes = np.asarray(detections.boxes, dtype=np.float64)
    blob = detections.areas < rules.solid * boxes[:, 2] * boxes[:, 3]
    if len(predicted) < 2 or not _may_cover_several(
        np.ascontiguousarray(boxes), blob, predicted, rules.covered, rules.larger
    ):
        return detections
    predicted = _distinct(predicted, rules.duplicate)
    share = covered_by(predicted, boxes).T
    larger = (boxes[:, None, 2:] > rules.larger * predicted[None, :, 2:]).any(axis=2)
    # A person belongs to one blob.
    inside = (share >= rules.covered) & larger & blob[:, None] & (share == share.max(axis=0))
    inside &= predicted[:, 3] >= rules.least * boxes[:, 3:]
    divisible = (inside & (predicted[:, 3] >= rules.tall * boxes[:, 3:])).any(axis=1)
    if deviation is not None:
        divisible |= deviation >= rules.excess
    inside &= divisible[:, None]
    several = np.flatnonzero(inside.sum(axis=1) >= 2)
    if len(several) == 0:
        return detections
    keep = np.flatnonzero(inside.sum(axis=1) < 2)
    sources = [(j, _shares_of(boxes[j], predicted[inside[j]], rules.largest_shift)) for j in several.tolist()]
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
def _may_cover_several(boxes, blob, predicted, least_cover, ratio):  # type: ignore[no-untyped-def]
    """Return True if any blob may cover two people or more; a fast test that ends most frames."""
    covered = covered_boxes(predicted, boxes)
    for j in range(len(boxes)):
        count = 0
        for k in range(len(predicted) if blob[j] else 0):
            larger = boxes[j, 2] > ratio * predicted[k, 2] or boxes[j, 3] > ratio * predicted[k, 3]
            if covered[k, j] >= least_cover and larger:
                count += 1
        if count >= 2:
            return True
    return False


def _distinct(people: Array, duplicate: float) -> Array:
    """Remove boxes that lie behind a nearer one or repeat it; of two people the one with the lower feet is nearer."""
    people = people[np.argsort(-(people[:, 1] + people[:, 3]), kind="stable")]
    share = covered_by(people, people)
    same = np.tril(np.maximum(share, share.T) >= duplicate, -1)
    return people[~same.any(axis=1)] if same.any() else people


def _shares_of(blob: Array, people: Array, largest_shift: float) -> Array:
    """Predicted boxes inside one blob, moved toward its edges. Shape (k, 4), px."""
    out = people.copy()
    for axis in (0, 1):
        low, high = people[:, axis], people[:, axis] + people[:, 2 + axis]
        first, last = int(np.argmin(low)), int(np.argmax(high))
        start, stop = blob[axis] - low[first], blob[axis] + blob[2 + axis] - high[last]
        shift = np.full(len(people), 0.5 * (start + stop))
        if first != last:
            shift[first], shift[last] = start, stop
        limit = largest_shift * people[:, 2 + axis]
        out[:, axis] += np.clip(shift, -limit, limit)
    return out
