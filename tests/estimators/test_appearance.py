"""Color histograms: bins, boxes, blobs."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.detect import box_appearance, box_histograms, color_bins
from servotrack.estimators.detect.appearance import run_appearance
from servotrack.estimators.detect.runs import label_runs


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)


@pytest.mark.parametrize("bins", [1, 4, 5, 8, 16])
def test_bins_are_of_equal_width(image, bins):
    red, green, blue = np.moveaxis(image.astype(int) * bins // 256, -1, 0)
    assert np.array_equal(color_bins(image, bins), (red * bins + green) * bins + blue)


def test_gray_is_a_color_of_equal_channels(image):
    gray = image[..., 0]
    assert np.array_equal(color_bins(gray), color_bins(np.repeat(gray[..., None], 3, axis=2)))


def test_boxes_count_the_pixels_whose_centers_they_hold(image):
    boxes = [[3.0, 4.0, 5.0, 6.0], [3.4, 4.6, 4.8, 5.0], [-5.0, 25.0, 10.0, 20.0], [50.0, 0.0, 5.0, 5.0]]
    parts = [image[4:10, 3:8], image[5:10, 3:8], image[25:30, 0:5], image[:0]]
    for shares, part in zip(box_histograms(image, boxes, 4), parts, strict=True):
        counts = np.zeros(64)
        if part.size:
            counts = np.bincount(color_bins(part, 4).ravel(), minlength=64) / (part.size / 3)
        np.testing.assert_allclose(shares, counts, atol=1e-12)


def test_appearances_are_unit_vectors_whose_product_is_the_bhattacharyya_coefficient(image):
    boxes = [[0.0, 0.0, 20.0, 15.0], [10.0, 5.0, 20.0, 15.0]]
    first, second = box_appearance(image, boxes)
    p, q = box_histograms(image, boxes)
    assert first @ first == pytest.approx(1.0)
    assert first @ second == pytest.approx(np.sqrt(p * q).sum())


def test_blobs_count_their_own_pixels(image):
    mask = np.zeros((30, 40), np.uint8)
    mask[2:10, 3:9] = 255
    mask[5, 9:15] = 255
    mask[20:25, 30:40] = 255
    runs, regions = label_runs(mask)
    first, second = run_appearance(image, runs, regions, 4)
    chosen = color_bins(image, 4)[:15][mask[:15] > 0]
    np.testing.assert_allclose(first**2, np.bincount(chosen, minlength=64) / len(chosen), atol=1e-12)
    np.testing.assert_allclose(second, box_appearance(image, [[30, 20, 10, 5]], 4)[0], atol=1e-12)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda image: color_bins(image, 0), "bins must be a whole number from 1 to 16, got 0"),
        (lambda image: color_bins(image / 255.0), "image must be uint8, got float64"),
        (lambda image: box_histograms(image, [[0.0, 0.0, np.nan, 1.0]]), "boxes must be finite"),
        (lambda image: box_histograms(image, [[0.0, 0.0, 1.0]]), r"shape \(k, 4\)"),
        (lambda image: box_histograms(image[..., :2], [[0, 0, 1, 1]]), "image must be RGB"),
    ],
)
def test_bad_input_is_named(image, call, match):
    with pytest.raises(ValueError, match=match):
        call(image)


def test_no_boxes(image):
    assert box_appearance(image, []).shape == (0, 512)
