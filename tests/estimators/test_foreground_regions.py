"""Regions of the foreground are no boxes of people: parts of one person, people in one region, and what scores say."""

from __future__ import annotations

import numpy as np
import pytest
from box_scenes import HEIGHT, person

from servotrack.estimators.boxes import BoxPMB, SplitRules, split_merged
from servotrack.estimators.detect import Detections, detections_from_boxes


def regions(boxes, confidences=None) -> Detections:
    """Regions that fill three quarters of their boxes."""
    found = detections_from_boxes(boxes, confidences)
    return found._replace(areas=0.75 * found.areas)


def test_the_parts_of_one_person_are_one_person() -> None:
    left, top, width, height = person(100.0)
    whole = regions([[left, top, width, height]])
    parts = np.array([[left, top, width, 0.45 * height], [left, top + 0.55 * height, width, 0.45 * height]])
    assert split_merged(whole, parts) is whole
    # The same region is two people one above the other where people are that small.
    assert len(split_merged(whole, parts, deviation=np.array([3.0])).boxes) == 2
    assert split_merged(whole, parts, deviation=np.array([1.0])) is whole
    assert len(split_merged(whole, parts, SplitRules(tall=0.4)).boxes) == 2


def test_a_fragment_beside_a_person_is_no_second_person() -> None:
    left, top, width, height = person(100.0)
    wide = regions([[left, top, 2.0 * width, height]])
    known = np.array([[left, top, width, height], [left + 1.5 * width, top + 0.7 * height, 0.5 * width, 0.3 * height]])
    assert split_merged(wide, known) is wide
    known[1] = left + width, top + 0.2 * height, width, 0.8 * height
    assert len(split_merged(wide, known).boxes) == 2


def test_the_nearer_one_of_two_boxes_in_one_place_stays() -> None:
    left, top, width, height = person(100.0)
    wide = regions([[left, top, 2.2 * width, height]])
    near, far = [left, top, width, height], [left + 2.0, top, 0.7 * width, 0.8 * height]
    beside = [left + 1.2 * width, top, width, height]
    parts = split_merged(wide, np.array([far, near, beside])).boxes
    assert sorted(parts[:, 3].tolist()) == [HEIGHT, HEIGHT]


def test_fragments_of_a_person_do_not_confirm_each_other() -> None:
    """Six pieces of a person come for a while; then the person is whole again, and one."""
    rng, tracker = np.random.default_rng(0), BoxPMB()
    left, top, width, height = person(100.0)
    pieces = [[left + 10.0 * (k % 2), top + 20.0 * (k // 2), 9.0, 19.0] for k in range(6)]
    state, counts = tracker.initial(regions(np.zeros((0, 4)))), []
    for k in range(60):
        boxes = np.array(pieces if k < 10 else [[left, top, width, height]])
        state, estimate = tracker.step(state, regions(boxes + rng.normal(0.0, 0.5, boxes.shape)))
        counts.append(len(estimate.labels))
    assert max(counts[10:]) <= 1 and counts[-1] == 1


@pytest.mark.parametrize("solid", [False, True])
def test_confidences_of_regions_are_visible_shares_and_not_chances(solid: bool) -> None:
    """A second person of low confidence comes: from a detector of people it is doubtful, a region is as good as any."""

    def frame(k: int) -> Detections:
        boxes, scores = [person(50.0 + k)], [1.0]
        if k >= 10:
            boxes, scores = [*boxes, person(200.0 - k)], [1.0, 0.4]
        return detections_from_boxes(boxes, scores) if solid else regions(boxes, scores)

    tracker = BoxPMB()
    state, counts = tracker.initial(frame(0)), []
    for k in range(14):
        state, estimate = tracker.step(state, frame(k))
        counts.append(len(estimate.labels))
    assert counts[10:] == [1 if solid else 2] * 4
