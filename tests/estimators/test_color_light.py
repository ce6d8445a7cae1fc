"""Light of color films: gains are found, pictures and histograms are relit, and the tracker keeps its object."""

from __future__ import annotations

import numpy as np
import pytest
from color_film import box, frame

from servotrack.envs.track.color.scoring import overlaps
from servotrack.estimators.color.histogram import color_histogram
from servotrack.estimators.color.light import LightMeter, relit, relit_histogram
from servotrack.estimators.color.monte_carlo_plus import MonteCarloColorPlus
from servotrack.estimators.color.turned_views import turned_views

SHAPE = (120, 160)
COUNT = 60
METER = LightMeter()


def room(seed: int) -> np.ndarray:
    """A wall with boards of many colors, brighter on one side; smooth enough to be the same wall in every frame."""
    rng = np.random.default_rng(seed)
    image = np.full((*SHAPE, 3), rng.uniform(60, 120, 3))
    for _ in range(25):
        left, top = rng.integers(0, SHAPE[1] - 10), rng.integers(0, SHAPE[0] - 10)
        image[top : top + rng.integers(8, 40), left : left + rng.integers(8, 40)] = rng.uniform(20, 170, 3)
    return image * np.linspace(0.8, 1.2, SHAPE[1])[None, :, None]


def head(seed: int) -> np.ndarray:
    """A face of skin with hair, eyes and mouth, 32 px high."""
    rng = np.random.default_rng(seed)
    image = np.full((32, 26, 3), rng.uniform([120, 70, 50], [190, 130, 100]))
    image[:9] = rng.uniform(20, 110, 3)
    image[13:16, 5:9] = image[13:16, 17:21] = (30, 30, 40)
    image[23:26, 8:18] = (130, 40, 45)
    return image * np.linspace(0.75, 1.15, 26)[None, :, None]


def film(gains: np.ndarray, seed: int, hidden: range = range(0)) -> tuple[list[np.ndarray], np.ndarray]:
    """Frames under gains (F, 3) with saturation and noise, in which a head walks to and fro, and its boxes.

    A green board stands before the head in the frames `hidden`.
    """
    rng = np.random.default_rng(seed)
    wall, face, frames, boxes = room(seed), head(seed), [], []
    for k, gain in enumerate(gains):
        left, top = round(60 + 30 * np.sin(0.08 * k)), round(40 + 14 * np.sin(0.05 * k + 1.0))
        image = wall.copy()
        image[top : top + 32, left : left + 26] = face
        if k in hidden:
            image[top - 6 : top + 38, left - 6 : left + 32] = (40, 150, 60)
        image = image * gain + rng.normal(0.0, 3.0, image.shape)
        frames.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        boxes.append([left, top, 26.0, 32.0])
    return frames, np.array(boxes)


def answers(frames: list[np.ndarray], first: np.ndarray, **settings: float) -> np.ndarray:
    tracker = MonteCarloColorPlus(**settings)
    state, found = tracker.initial(frames[0], first), [first]
    for image in frames[1:]:
        state, estimate = tracker.step(state, image)
        found.append(estimate.box)
    return np.array(found)


def ramp(to: float | tuple[float, float, float]) -> np.ndarray:
    """Gains (F, 3) from 1 to the given ones and back."""
    share = np.interp(np.arange(COUNT), [0, 5, 25, 35, 55, COUNT], [0, 0, 1, 1, 0, 0])
    return np.exp(share[:, None] * np.log(np.broadcast_to(to, 3)))


def switches(to: float | tuple[float, float, float]) -> np.ndarray:
    """Gains (F, 3) that are the given ones in every other 10 frames, from one frame to the next."""
    return np.where((np.arange(COUNT) // 10 % 2 == 1)[:, None], np.broadcast_to(to, 3), 1.0)


LIGHTS = {
    "still": ramp(1.0),
    "ramp to 3": ramp(3.0),
    "ramp to a third": ramp(1 / 3),
    "ramp of tint": ramp((1.6, 1.0, 0.55)),
    "ramp to bright and blue": ramp((1.2, 1.7, 2.4)),
    "switch to 2.5": switches(2.5),
    "switch to a third": switches(1 / 3),
    "switch of tint": switches((0.6, 1.1, 1.7)),
}


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_object_is_kept_under_changing_light(name: str, seed: int) -> None:
    frames, boxes = film(LIGHTS[name], seed)
    assert overlaps(answers(frames, boxes[0]), boxes).min() > 0.6


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gains_are_found_within_a_tenth(name: str, seed: int) -> None:
    gains = LIGHTS[name]
    frames, _ = film(gains, seed)
    light = METER.initial(frames[0])
    for image, gain in zip(frames[1:], gains[1:], strict=True):
        light = METER.next(light, image)
        assert np.abs(light.gains - np.log(gain)).max() < 0.1


def test_under_still_light_the_answers_have_the_bits_of_a_tracker_that_knows_no_light(monkeypatch) -> None:
    frames, boxes = film(LIGHTS["still"], 4, hidden=range(20, 26))
    with_light = answers(frames, boxes[0])
    monkeypatch.setattr(LightMeter, "next", lambda self, light, image: light)
    assert np.array_equal(with_light, answers(frames, boxes[0]))


def test_an_occlusion_is_no_light_and_light_is_no_occlusion() -> None:
    tracker = MonteCarloColorPlus()
    frames, boxes = film(LIGHTS["ramp to 3"], 5, hidden=range(12, 16))
    state = tracker.initial(frames[0], boxes[0])
    for k, image in enumerate(frames[1:], 1):
        before = state
        state, _ = tracker.step(state, image)
        hidden = np.array_equal(state.recent, before.recent)
        assert hidden == (12 <= k < 16)


def test_a_cut_to_another_view_says_nothing_about_the_light() -> None:
    frames, _ = film(LIGHTS["still"], 6)
    light = METER.next(METER.initial(frames[0]), frames[1])
    cut = np.random.default_rng(7).integers(0, 256, frames[0].shape, dtype=np.uint8)
    assert np.array_equal(METER.next(light, cut).gains, light.gains)
    assert np.array_equal(METER.next(light, np.full_like(cut, 255)).gains, light.gains)
    # Back in the first view, its light is known again.
    assert np.abs(METER.next(METER.next(light, np.full_like(cut, 255)), frames[2]).gains).max() < 0.02


def test_a_saturated_channel_changes_as_the_others_do() -> None:
    image = np.full((60, 80, 3), (252, 90, 60), np.uint8)
    brighter = np.full((60, 80, 3), (255, 108, 72), np.uint8)
    assert METER.next(METER.initial(image), brighter).gains == pytest.approx(np.log([1.2, 1.2, 1.2]), abs=0.02)


def test_pictures_are_relit_as_the_sensor_would_see_them() -> None:
    image = np.array([[[10, 100, 200], [0, 255, 128]]], np.uint8)
    assert relit(image, np.log([2.0, 0.5, 1.5])).tolist() == [[[20, 50, 255], [0, 128, 192]]]
    assert np.array_equal(relit(image, np.zeros(3)), image)


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0), (2.0, 0.5, 1.3), (6.0, 6.0, 6.0)])
def test_histograms_are_relit_as_pictures_are(gains: tuple[float, float, float]) -> None:
    image = np.random.default_rng(8).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    whole, logarithm = np.array([0.0, 0.0, 200.0, 200.0]), np.log(gains)
    found = relit_histogram(color_histogram(image, whole, 4), logarithm, 4)
    assert found.sum() == pytest.approx(1.0)
    assert np.abs(found - color_histogram(relit(image, logarithm), whole, 4)).sum() < 0.06


def test_views_are_drawn_anew_only_where_they_are_asked_for_and_the_light_has_changed() -> None:
    image, first = frame(40, 30), box(40, 30)
    views = turned_views(image, first, 8, 5)
    assert views.under(np.full(3, 0.05), np.arange(8), 0.1, 1.0) is views
    bright = views.under(np.full(3, 1.0), np.array([0, 2]), 0.1, 1.0)
    assert [k for k in range(8) if not np.array_equal(bright.features[k], views.features[k])] == [0, 2]
    assert np.allclose(bright.features[0], turned_views(relit(image, np.ones(3)), first, 8, 5).features[0], atol=1e-3)
    assert views.unsaturated(np.zeros(3)) == 1.0
    assert views.unsaturated(np.full(3, 3.0)) < 0.1
