"""Color histograms of many boxes: the integral one is the direct count, and the coefficient is what it should be."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.color.cells import ORIENTATIONS, direction
from servotrack.estimators.color.histogram import bhattacharyya, color_histogram, similarities


def image(shape: tuple[int, int] = (60, 80), colors: int = 256) -> np.ndarray:
    return np.random.default_rng(4).integers(0, colors, (*shape, 3), dtype=np.uint8)


def boxes(count: int = 40) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(-30, 80, count), rng.uniform(-30, 60, count), rng.uniform(0.2, 50, (count, 2))])


@pytest.mark.parametrize("bins", [1, 4, 8, 16])
def test_the_integral_histogram_is_the_direct_count(bins: int) -> None:
    frame = image(colors=120)
    reference = color_histogram(frame, np.array([10.0, 12.0, 20.0, 16.0]), bins)
    found = similarities(frame, boxes(), reference, bins)
    direct = [bhattacharyya(reference, color_histogram(frame, box, bins)) for box in boxes()]
    np.testing.assert_allclose(found, direct, rtol=1e-12, atol=1e-15)
    assert (found > 0.0).any()
    assert (found == 0.0).any()


def test_boxes_of_more_pixels_than_sixteen_bits_count_are_counted_right() -> None:
    frame = np.zeros((300, 400, 3), np.uint8)
    frame[:, 200:] = 255
    reference = color_histogram(frame, np.array([0.0, 0.0, 400.0, 300.0]))
    assert similarities(frame, np.array([[0.0, 0.0, 400.0, 300.0]]), reference)[0] == pytest.approx(1.0)
    assert similarities(frame, np.array([[200.0, 0.0, 200.0, 300.0]]), reference)[0] == pytest.approx(np.sqrt(0.5))


def test_bhattacharyya_is_one_with_itself_zero_apart_and_symmetric() -> None:
    p, q = (np.random.default_rng(seed).dirichlet(np.ones(12)) for seed in (1, 2))
    assert bhattacharyya(p, p) == pytest.approx(1.0)
    assert bhattacharyya(p, q) == bhattacharyya(q, p) < 1.0
    assert bhattacharyya(np.repeat([1.0, 0.0], 6) / 6, np.repeat([0.0, 1.0], 6) / 6) == 0.0
    halves, point = np.array([0.5, 0.5, 0.0]), np.array([1.0, 0.0, 0.0])
    assert bhattacharyya(halves, point) == pytest.approx(np.sqrt(0.5))


def test_a_pixel_belongs_to_the_box_that_holds_its_center() -> None:
    frame = np.zeros((4, 4, 3), np.uint8)
    frame[1, 2] = 255
    assert color_histogram(frame, np.array([2.4, 1.4, 0.5, 0.5]))[-1] == 1.0
    assert color_histogram(frame, np.array([2.6, 1.4, 1.0, 0.5]))[-1] == 0.0


def test_a_gradient_goes_to_the_direction_along_which_it_is_strongest() -> None:
    axes = np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    for dx, dy in np.random.default_rng(6).integers(-255, 256, (500, 2)).astype(np.float32):
        along = np.abs(np.cos(axes) * dx + np.sin(axes) * dy)
        assert along[direction(dx, dy)] == pytest.approx(along.max(), rel=1e-5)
