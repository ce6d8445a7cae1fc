"""Regions that several known people share: the people in one, and what it says about where they are.

Two people who meet become one region of the foreground. It is not the box of either: it says that both are inside of
it. A track that took it for its own would grow and jump, and the other one would go on where it had been heading; when
they part, they would have changed places.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.kalman import correct_place
from servotrack.estimators.boxes.overlap import covered_boxes
from servotrack.estimators.compilation import njit


class SharingRules(NamedTuple):
    """Conditions under which people share a region.

    Attributes:
        longest: Time for which people who share a region are followed within it, s. Raising it keeps identities apart
            in longer meetings, and reports more people where a track was started by mistake.
        covered: Smallest share of a predicted box within the region for the person to be in it.
        height: Smallest height of a person in the region, heights of the region; shorter tracks may be its parts.
        sure: Distance to the next person from which one is surely the outermost of a region and touches its edge,
            standard deviations. Raising it trusts the predicted order for a shorter time.
    """

    longest: float = 1.0
    covered: float = 0.6
    height: float = 0.75
    sure: float = 3.0


@njit(cache=True, nogil=True)
def shared_regions(predicted, known, boxes, region, partner, rules):  # type: ignore[no-untyped-def]
    """Region that each track shares with others, -1 for none.

    Args:
        predicted: Predicted boxes of the tracks. Shape (T, 4), px.
        known: Mask of the tracks that may share. Shape (T,).
        boxes: Detected boxes. Shape (Z, 4), px.
        region: Mask of the detections that are regions of the foreground. Shape (Z,).
        partner: Detection of each track in the best assignment, -1 for none. Shape (T,).
        rules: A `SharingRules`.

    Returns:
        Shape (T,).
    """
    shared = np.full(predicted.shape[0], -1)
    cover = covered_boxes(predicted, boxes)
    member = np.empty(predicted.shape[0], np.bool_)
    for j in range(boxes.shape[0]):
        if not region[j]:
            continue
        members, without = 0, 0
        for i in range(predicted.shape[0]):
            tall = predicted[i, 3] >= rules.height * boxes[j, 3]
            member[i] = known[i] and tall and cover[i, j] >= rules.covered and (partner[i] == j or partner[i] < 0)
            members += member[i]
            without += member[i] and partner[i] < 0
        if members < 2 or without == 0:
            continue
        for i in range(predicted.shape[0]):
            if member[i] and (shared[i] < 0 or cover[i, j] > cover[i, shared[i]]):
                shared[i] = j
    return shared


@njit(cache=True, nogil=True)
def correct_within(mean, variance, shared, boxes, noise, rules):  # type: ignore[no-untyped-def]
    """Kalman correction, in place, of the tracks that share a region.

    The person who is surely the outermost one on a side touches that edge of the region. All others are anywhere
    within it: which of two people is the left one is not known after they were one behind the other.

    Args:
        mean: Means as in `predict_boxes`; changed. Shape (T, 6).
        variance: Variances as in `predict_boxes`; changed. Shape (T, 8).
        shared: Region of each track, -1 for none. Shape (T,).
        boxes: Detected boxes. Shape (Z, 4), px.
        noise: Standard deviations of a measured center column, center row, width and height, heights. Shape (4,).
        rules: A `SharingRules`.
    """
    before, spread = mean.copy(), variance.copy()
    for i in range(mean.shape[0]):
        j = shared[i]
        if j < 0:
            continue
        for axis in range(2):
            a, p = 2 * axis, 3 * axis
            size, own = mean[i, 4 + axis], (noise[axis] * mean[i, 5]) ** 2
            slack = 0.5 * max(boxes[j, 2 + axis] - size, 0.0)
            middle = boxes[j, axis] + 0.5 * boxes[j, 2 + axis]
            first, last = True, True
            for k in range(mean.shape[0]):
                if k == i or shared[k] != j:
                    continue
                least = rules.sure * math.sqrt(spread[i, p] + spread[k, p])
                half = 0.5 * (before[k, 4 + axis] - size)
                first = first and before[k, a] - half - before[i, a] > least
                last = last and before[i, a] - before[k, a] - half > least
            if first or last:
                correct_place(mean[i], variance[i], axis, middle + slack * (int(last) - int(first)), own)
            else:
                mean[i, a] = middle
                variance[i, p] = max(variance[i, p], slack**2)
