"""Heights of a scene: fragments do not lower them, unsupported ones divide nothing, and both are said."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.detect import BlobFinder
from servotrack.estimators.detect.scene_sizes import SceneSizes, contradicted, supported

SHAPE = (288, 384)
IMAGE = np.full((*SHAPE, 3), 128, np.uint8)


def height_at(foot):
    return 0.5 * foot - 20.0


def add(mask, x, foot, height, width):
    mask[int(foot - height) : int(foot), int(x - width / 2) : int(x + width / 2)] = 255


def crowd(rng, fragments=0, spread=0.05, people=2):
    """People apart from each other on flat ground, and upright fragments a fifth as tall."""
    mask = np.zeros(SHAPE, np.uint8)
    for x in np.linspace(40, 340, people + fragments):
        foot = rng.uniform(140, 270)
        if fragments and rng.random() < fragments / (people + fragments):
            add(mask, x, foot, 0.2 * height_at(foot) + 4, 6)
        else:
            height = height_at(foot) * rng.normal(1.0, spread)
            add(mask, x, foot, height, 0.35 * height)
    return mask


def learned(finder, frames=150, **kind):
    rng = np.random.default_rng(1)
    state, counts = finder.initial(), []
    for _ in range(frames):
        state, found = finder.step(state, crowd(rng, **kind), IMAGE)
        counts.append(len(found.boxes))
    return state, counts


@pytest.mark.parametrize("fragments", [0, 4])
def test_heights_are_those_of_people_however_many_fragments_there_are(fragments):
    state, counts = learned(BlobFinder(), fragments=fragments)
    assert supported(state, BlobFinder().scene)
    for foot in (150.0, 200.0, 260.0):
        assert state.line.intercept + state.line.slope * foot == pytest.approx(height_at(foot), rel=0.1)
    # Detections do not grow: what is too small for a person is left out, and people are not divided.
    assert max(counts[-50:]) <= 2 + fragments
    assert np.mean(counts[-50:]) <= 2.5


def test_people_side_by_side_are_divided_where_people_were_seen_and_not_beyond():
    state, _ = learned(BlobFinder())
    height = height_at(200.0)
    pair = np.zeros(SHAPE, np.uint8)
    add(pair, 150, 200, height, 0.36 * height)
    add(pair, 150 + 0.36 * height, 200, height, 0.36 * height)
    assert len(BlobFinder().step(state, pair, IMAGE)[1].boxes) == 2
    low = state._replace(line=state.line._replace(last_row=150.0))
    assert len(BlobFinder().step(low, pair, IMAGE)[1].boxes) == 1


def test_a_scene_whose_heights_follow_no_line_divides_nothing_and_says_so():
    finder = BlobFinder()
    state, counts = learned(finder, frames=250, spread=0.5)
    assert isinstance(state, SceneSizes) and not supported(state, finder.scene)
    assert max(counts[-50:]) <= 2
    notice = finder.notice(state)
    assert "people who touch count as one" in notice and "--detector model.onnx" in notice
    sound, _ = learned(finder, frames=250)
    assert finder.notice(sound) == ""


def test_a_line_that_would_divide_most_single_people_is_given_up():
    finder = BlobFinder()
    state, _ = learned(finder, frames=200)
    # Heights that a feedback has halved; the pixels still agree, as they would after being learned from parts.
    wrong = state._replace(line=state.line._replace(intercept=-10.0, slope=0.25), fitted=1e9)
    rng, counts = np.random.default_rng(3), []
    for _ in range(60):
        wrong, found = finder.step(wrong, crowd(rng), IMAGE)
        counts.append(len(found.boxes))
    assert contradicted(wrong, finder.scene) > finder.scene.contradiction and "would be divided" in finder.notice(wrong)
    assert counts[-1] == 2 and max(counts[:5]) > 2


def test_the_scale_of_the_scene_decides_what_is_too_small():
    """Whether people are 20 px or 200 px tall, a region with a tenth of their pixels is none."""
    for scale in (0.25, 1.0):
        finder, rng = BlobFinder(), np.random.default_rng(5)
        state = finder.initial()
        for k in range(80):
            mask = np.zeros(SHAPE, np.uint8)
            height = scale * height_at(230) * rng.normal(1.0, 0.04)
            add(mask, 100 + 2 * k, 230, height, 0.36 * height)
            small = max(0.3 * height, 7)
            add(mask, 350, 230, small, 0.36 * small)
            state, found = finder.step(state, mask, IMAGE)
        assert len(found.boxes) == 1


def test_before_people_are_known_specks_beside_a_person_are_none_and_alone_they_count():
    finder, person, specks = BlobFinder(), np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.uint8)
    add(person, 100, 230, 95, 34)
    for mask in (person, specks):
        add(mask, 300, 60, 6, 10)
        add(mask, 250, 200, 10, 4)
    _, found = finder.step(finder.initial(), person, IMAGE)
    assert found.boxes.tolist() == [[83.0, 135.0, 34.0, 95.0]]
    assert len(finder.step(finder.initial(), specks, IMAGE)[1].boxes) == 2
