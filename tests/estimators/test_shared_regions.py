"""Two people who meet and part: one region of the foreground for both, and their identities after it."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.boxes import BoxPMB
from servotrack.estimators.boxes.shared import SharingRules, shared_regions
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.types import Array

HEIGHTS, FEET = (80.0, 92.0), (205.0, 200.0)


def people(k: int, crossing: bool, seed: int) -> Array:
    """Two people who walk toward each other, stand together for 15 frames, and go back, or on. Shape (2, 4), px."""
    near = np.interp(k, [0, 40, 55, 95], [120.0, 8.0, 8.0, 120.0])
    side = -1.0 if crossing and k > 47 else 1.0
    x = 200.0 + 0.5 * near * side * np.array([-1.0, 1.0]) + np.random.default_rng([seed, k]).normal(0.0, 0.7, 2)
    width = np.array([26.0, 28.0])
    return np.column_stack([x - width / 2, np.subtract(FEET, HEIGHTS), width, HEIGHTS])


def regions(boxes: Array) -> Detections:
    """What a background subtraction finds: one region where the two touch."""
    left, right = boxes[np.argsort(boxes[:, 0])]
    if left[0] + left[2] >= right[0]:
        low = boxes[:, :2].min(axis=0)
        boxes = np.concatenate([low, (boxes[:, :2] + boxes[:, 2:]).max(axis=0) - low])[None]
    centers = boxes[:, :2] + boxes[:, 2:] / 2.0
    none = np.zeros((len(boxes), 0))
    return Detections(boxes, centers, 0.7 * boxes[:, 2] * boxes[:, 3], np.ones(len(boxes)), none)


def play(crossing: bool, seed: int, sharing: SharingRules) -> tuple[bool, float]:
    """Whether both identities are kept, and the share of frames of the meeting in which two people are reported."""
    tracker = BoxPMB(frame_rate=25.0, frame_size=(400, 300), sharing=sharing)
    state = tracker.initial(regions(people(0, crossing, seed)))
    names, numbers = {}, []
    for k in range(96):
        true = people(k, crossing, seed)
        found = regions(true)
        state, estimate = tracker.step(state, found)
        if len(found.boxes) == 1:
            numbers.append(len(estimate.labels))
        if k in (25, 90):
            middle = estimate.states[:, 0] + estimate.states[:, 2] / 2.0
            near = np.abs(true[:, :1] + true[:, 2:3] / 2.0 - middle).argmin(axis=1)
            names[k] = estimate.labels[near].tolist()
    return names[25] == names[90], float(np.mean(np.array(numbers) == 2))


@pytest.mark.parametrize("crossing", [False, True], ids=["they part as they came", "they pass each other"])
def test_two_who_meet_keep_their_identities_and_count_as_two(crossing: bool) -> None:
    kept, two = zip(*(play(crossing, seed, SharingRules()) for seed in range(12)), strict=True)
    assert sum(kept) >= 9
    assert np.mean(two) > 0.9


def test_without_sharing_one_of_the_two_is_not_counted() -> None:
    _, two = play(False, 0, SharingRules(longest=0.0))
    assert two < 0.5


def test_parts_of_a_person_do_not_share_the_person() -> None:
    region = np.array([[100.0, 100.0, 40.0, 100.0]])
    halves = np.array([[100.0, 100.0, 38.0, 50.0], [102.0, 150.0, 38.0, 50.0]])
    side_by_side = np.array([[100.0, 100.0, 24.0, 96.0], [116.0, 104.0, 24.0, 96.0]])
    yes, partner = np.ones(2, np.bool_), np.array([0, -1])
    for predicted, wanted in ((halves, [-1, -1]), (side_by_side, [0, 0])):
        found = shared_regions(predicted, yes, region, np.ones(1, np.bool_), partner, SharingRules())
        assert found.tolist() == wanted
    # A box of a detector stands for one person, and so does a region whose people all have their own.
    assert shared_regions(side_by_side, yes, region, np.zeros(1, np.bool_), partner, SharingRules()).tolist() == [
        -1,
        -1,
    ]
    assert shared_regions(
        side_by_side, yes, region, np.ones(1, np.bool_), np.array([0, 0]), SharingRules()
    ).tolist() == [-1, -1]
