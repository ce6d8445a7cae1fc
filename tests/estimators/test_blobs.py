"""From masks to people: runs against OpenCV's components, sizes that are learned, parts joined, groups divided."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder
from servotrack.estimators.detect.bodies import Cover, body_line, learn_sizes, no_sizes
from servotrack.estimators.detect.runs import label_again, label_runs, measure_runs

SHAPE = (288, 384)
IMAGE = np.full((*SHAPE, 3), 128, np.uint8)


def bands(**parameters):
    """A finder that learns heights per band of rows, as the worlds' detector does."""
    return BlobFinder(**({"opening": 3, "smallest": 40, "scene": None} | parameters))


def person_height(foot):
    return 10.0 + 0.25 * foot


def draw(mask, x, foot, height=None, cut=None):
    """A person as three ellipses: head, trunk and legs."""
    h = person_height(foot) if height is None else height
    for center, axes in ((0.93, (0.06, 0.07)), (0.65, (0.16, 0.22)), (0.25, (0.12, 0.25))):
        cv2.ellipse(mask, ((x, foot - center * h), (2 * axes[0] * h, 2 * axes[1] * h), 0.0), 255, -1)
    if cut is not None:
        mask[int(foot - cut[1] * h) : int(foot - cut[0] * h)] = 0
    return mask


def blank():
    return np.zeros(SHAPE, np.uint8)


@pytest.fixture(scope="module")
def taught():
    """A finder's state after a while of single people at all depths."""
    finder, rng = bands(), np.random.default_rng(0)
    state = finder.initial()
    for _ in range(60):
        mask = blank()
        for x in (60, 180, 300):
            draw(mask, x, rng.uniform(120, 280))
        state, _found = finder.step(state, mask, IMAGE)
    return state


@pytest.mark.parametrize("seed", range(20))
def test_runs_are_connected_as_opencv_connects_them(seed):
    rng = np.random.default_rng(seed)
    side = 1 + seed % 5
    width = (70, 72)[seed // 10]  # rows that are whole numbers of words are read in words
    mask = (cv2.blur(rng.random((50, width)), (side, side)) > 0.55).astype(np.uint8)
    runs, regions = label_runs(mask)
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask)
    assert regions == count - 1
    ours = np.zeros_like(labels)
    for row, first, stop, number in runs:
        ours[row, first:stop] = number + 1
    # The same regions under other numbers.
    pairs = np.unique(np.stack([ours.ravel(), labels.ravel()]), axis=1)
    assert pairs.shape[1] == count
    boxes, centers, areas = measure_runs(runs, regions)
    order = pairs[1, 1:]
    np.testing.assert_array_equal(boxes, stats[order, :4])
    np.testing.assert_array_equal(areas, stats[order, 4])
    np.testing.assert_allclose(centers, centroids[order] + 0.5, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_shortened_runs_are_labeled_as_their_pixels(seed):
    rng = np.random.default_rng(seed)
    mask = (cv2.blur(rng.random((50, 72)), (3, 3)) > 0.5).astype(np.uint8)
    runs, _ = label_runs(mask)
    runs[:, 2] -= rng.integers(0, 3, len(runs))
    runs[(runs[:, 1] >= runs[:, 2]) | (rng.random(len(runs)) < 0.2), 3] = -1
    left = np.zeros_like(mask)
    for row, first, stop, number in runs:
        left[row, first:stop] = number >= 0
    for ours, wanted in zip(label_again(runs), label_runs(left), strict=True):
        np.testing.assert_array_equal(ours, wanted)


def test_specks_go_and_bodies_hold_together():
    mask = blank()
    mask[100:140, 100:114] = 255
    mask[118:122, 100:114] = 0
    mask[40:42, 40:42] = 255
    mask[60:65, 60:66] = 255
    _, found = bands().step(bands().initial(), mask, IMAGE)
    np.testing.assert_array_equal(found.boxes, [[100, 100, 14, 40]])
    np.testing.assert_array_equal(found.centroids, [[107, 120]])
    assert found.areas.tolist() == [560]
    _, apart = bands(closing=(1, 1)).step(bands().initial(), mask, IMAGE)
    assert len(apart.boxes) == 2


def test_heights_are_learned_by_row(taught):
    intercept, slope = body_line(taught, SHAPE[0], Cover())
    for foot in (130, 200, 270):
        assert intercept + slope * foot == pytest.approx(person_height(foot), rel=0.08)


def test_heights_are_not_learned_from_groups_or_strips(taught):
    sizes = no_sizes()
    odd = np.array([[50.0, 50.0, 60.0, 50.0], [50.0, 50.0, 4.0, 60.0], [0.0, 50.0, 16.0, 40.0]])
    assert learn_sizes(sizes, odd, odd[:, 2] * odd[:, 3], SHAPE, Cover()).counts.sum() == 0.0
    assert body_line(sizes, SHAPE[0], Cover()) is None


@pytest.mark.parametrize(
    "people",
    [
        [(150, 220)],
        [(150, 220), (168, 222)],
        [(150, 220), (168, 228), (186, 216)],
        [(150, 200), (154, 240)],
    ],
)
def test_people_who_touch_are_told_apart(taught, people):
    mask = blank()
    for x, foot in people:
        draw(mask, x, foot)
    assert label_runs(mask)[1] == 1
    _, found = bands().step(taught, mask, IMAGE)
    assert len(found.boxes) == len(people)
    centers = found.boxes[:, :2] + found.boxes[:, 2:] / 2.0
    for x, foot in people:
        h = person_height(foot)
        assert np.hypot(*(centers - (x, foot - h / 2)).T).min() < 0.2 * h
    # Every pixel belongs to one of them.
    assert found.areas.sum() == pytest.approx(np.count_nonzero(bands().clean(mask)))


def test_without_splitting_they_are_one(taught):
    mask = draw(draw(blank(), 150, 220), 168, 222)
    _, found = bands(split=False).step(taught, mask, IMAGE)
    assert len(found.boxes) == 1


def test_parts_of_one_person_are_joined(taught):
    mask = draw(blank(), 150, 240, cut=(0.4, 0.6))
    assert label_runs(bands().clean(mask))[1] == 2
    _, found = bands().step(taught, mask, IMAGE)
    assert len(found.boxes) == 1
    assert found.boxes[0, 3] == pytest.approx(person_height(240), rel=0.08)
    _, whole = bands().step(taught, draw(blank(), 150, 240), IMAGE)
    assert found.confidences[0] < whole.confidences[0] == 1.0


def test_a_few_people_are_enough_to_join_parts_and_too_few_to_divide_a_group():
    finder = bands()
    state = finder.initial()
    for k in range(20):
        state, _ = finder.step(state, draw(blank(), 60 + 5 * k, 240), IMAGE)
    _, found = finder.step(state, draw(blank(), 150, 240, cut=(0.4, 0.6)), IMAGE)
    assert len(found.boxes) == 1
    _, found = finder.step(state, draw(draw(blank(), 150, 240), 172, 240), IMAGE)
    assert len(found.boxes) == 1
    _, found = finder.step(finder.initial(), draw(blank(), 150, 240, cut=(0.4, 0.6)), IMAGE)
    assert len(found.boxes) == 2


def test_people_too_far_away_are_left_out(taught):
    mask = draw(draw(blank(), 100, 25), 200, 240)
    _, found = bands(opening=1).step(taught, mask, IMAGE)
    assert len(found.boxes) == 1
    _, found = bands(opening=1, least_height=0.0).step(taught, mask, IMAGE)
    assert len(found.boxes) == 2


def test_colors_are_those_of_the_pixels_of_each(taught):
    mask, image = draw(draw(blank(), 150, 220), 169, 220), IMAGE.copy()
    image[:, :160], image[:, 160:] = (200, 30, 30), (30, 30, 200)
    _, found = bands().step(taught, mask, image)
    red, blue = found.features[np.argsort(found.boxes[:, 0])]
    assert red @ red == pytest.approx(1.0)
    assert red @ blue < 0.3
    _, plain = bands(bins=0).step(taught, mask, image)
    assert plain.features.shape == (2, 0)


def test_a_state_is_not_changed_by_a_step(taught):
    before = taught.heights.copy(), taught.counts.copy()
    bands().step(taught, draw(blank(), 150, 220), IMAGE)
    np.testing.assert_array_equal(before, taught)


def test_masks_without_and_full_of_foreground(taught):
    for value in (0, 255):
        _, found = bands().step(taught, np.full(SHAPE, value, np.uint8), IMAGE)
        assert found.boxes.shape[1:] == (4,)
        assert (len(found.boxes) > 0) == (value > 0)
        assert np.isfinite(np.concatenate([part.ravel() for part in found])).all()


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"opening": 0}, "opening must be a whole number"),
        ({"closing": (0, 3)}, "closing must be two whole numbers"),
        ({"smallest": 0}, "smallest must be at least 1"),
        ({"bins": 20}, "bins must be a whole number"),
        ({"least_height": -1.0}, "least_height must be finite"),
    ],
)
def test_bad_parameters_are_named(arguments, match):
    with pytest.raises(ValueError, match=match):
        bands(**arguments)


def test_a_mask_of_another_size_is_named():
    with pytest.raises(ValueError, match=r"mask must have the shape \(288, 384\)"):
        bands().step(bands().initial(), np.zeros((10, 10), np.uint8), IMAGE)


@pytest.mark.parametrize("turned", [False, True])
def test_a_camera_on_its_side_is_said(turned):
    finder, rng = BlobFinder(), np.random.default_rng(0)
    state, said = finder.initial(), ""
    for _ in range(110):
        mask = blank()
        for x in (60, 180, 300):
            draw(mask, x, 200 + rng.uniform(-30, 30), 70)
        mask = np.ascontiguousarray(mask.T) if turned else mask
        image = np.full((*mask.shape, 3), 128, np.uint8)
        state, _ = finder.step(state, mask, image)
        said = finder.notice(state)
    assert ("turn the picture" in said) == turned
