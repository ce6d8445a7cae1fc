"""Light of a film: gains of the color channels since the first frame, and pictures and histograms under other gains.

The sensor is modeled as gain and saturation, min(255, gain * value). Gains in this form also describe light on
gamma-encoded values, white balance and exposure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, Image

SAMPLES = 1000
"""Approximate number of pixels that are compared from frame to frame."""
_DARK, _BRIGHT = 24, 250
"""Pixels are compared if their mean is above the one and both values are below the other."""
_STEP = 0.02
"""Width of a bin of logarithmic ratios."""
_HALF = 120
"""Bins on each side of the ratio 1, which limits a change from frame to frame to a factor of 11."""
_WINDOW = 8.0
"""Half width of the triangular window around the most frequent ratio, bins."""
_ROUNDS, _CLOSE = 10, 0.01
"""Largest number of steps of the mean shift, and the step at which it ends, bins."""
_FEW = 0.02
"""Share of the samples that must be comparable."""
_AGREEMENT = 0.12
"""Share of the comparable samples, weighted by the window, that must have the most frequent ratio."""
_SUPPORT = 0.5
"""The earlier frame is replaced if fewer pixels than this share of the most so far agree."""
_LARGEST = 2.5
"""Limit of the logarithm of gains."""
_LOG = np.concatenate([[0.0], np.log(np.arange(1.0, 256.0))]).astype(np.float32)


class Light(NamedTuple):
    """Estimated light of the last frame.

    Attributes:
        gains: Logarithm of the gains of red, green and blue since the first frame, shape (3,).
        key: Pixels of an earlier frame on a grid, shape (h, w, 3), uint8.
        key_gains: Gains of that frame, shape (3,).
        support: Largest number of pixels that agreed about the change since that frame, weighted by the window.
    """

    gains: Array
    key: Image
    key_gains: Array
    support: float


def first_light(image: Image) -> Light:
    """Return the light of the first frame, whose gains are 1 by definition.

    Args:
        image: RGB, shape (H, W, 3), uint8.
    """
    stride = _stride(image.shape)
    return Light(np.zeros(3), image[::stride, ::stride].copy(), np.zeros(3), 0.0)


def next_light(light: Light, image: Image) -> Light:
    """Estimate the gains in the next frame from the most frequent ratio of its pixels to those of an earlier frame.

    Pixels on moving objects and edges have other ratios, which are no majority. Saturated and dark pixels are left
    out. The earlier frame is kept as long as most of its pixels are comparable, so that the error does not grow while
    the camera rests. A channel that cannot be compared changes as the others do.

    Args:
        light: Light of the last frame.
        image: RGB, of the same shape as the frames before, uint8.
    """
    now, change, comparable, agreement = np.empty_like(light.key), np.zeros(3), np.zeros(3), np.zeros(3)
    _compare(image, light.key, _stride(image.shape), _LOG, now, change, comparable, agreement)
    known = comparable >= max(_FEW * now[..., 0].size, 1.0)
    if not known.any():
        return light
    if agreement[known].min() < _AGREEMENT:
        # Another view: nothing is known about its light.
        return Light(light.gains, now, light.gains, 0.0)
    everywhere = known.all()
    if not everywhere:
        change[~known] = change[known].mean()
    gains = np.minimum(np.maximum(light.key_gains + change, -_LARGEST), _LARGEST)
    support = float((comparable * agreement).min())
    if everywhere and support < _SUPPORT * light.support:
        return Light(gains, now, gains, 0.0)
    return light._replace(gains=gains, support=max(support, light.support))


def relit(image: Image, gains: Array) -> Image:
    """Return a picture under other light.

    Args:
        image: RGB, shape (h, w, 3), uint8.
        gains: Logarithm of the gains, shape (3,).
    """
    out = np.empty_like(image)
    _relight(image, exponential(gains).astype(np.float32), out)
    return out


def relit_histogram(histogram: Array, gains: Array, bins: int) -> Array:
    """Return a color histogram under other light; the colors of a bin are taken as equally frequent.

    Args:
        histogram: Share of each color bin, shape (bins ** 3,).
        gains: Logarithm of the gains, shape (3,).
        bins: Number of bins of each channel.
    """
    edges = np.arange(bins + 1.0)
    cube = histogram.reshape(bins, bins, bins)
    for gain in exponential(gains):
        # Share of the interval of each old bin that is stretched below each edge; the last edge has all.
        below = np.minimum(np.maximum(edges[:, None] / gain - edges[None, :-1], 0.0), 1.0)
        below[-1] = 1.0
        # Every pass moves the next channel to the front.
        cube = np.tensordot(cube, np.diff(below, axis=0), axes=(0, 1))
    return cube.reshape(-1)


def _stride(shape: tuple[int, ...]) -> int:
    return max(1, int(np.sqrt(shape[0] * shape[1] / SAMPLES)))


@njit(cache=True, nogil=True)
def _most_frequent(counts, channel, change, comparable, agreement):  # type: ignore[no-untyped-def]
    """Find the most frequent ratio of one channel by mean shift from the median."""
    total, so_far, middle = counts.sum(), 0, 0
    comparable[channel] = total
    while 2 * (so_far + counts[middle]) < total:
        so_far += counts[middle]
        middle += 1
    center = float(middle)
    for _ in range(_ROUNDS):
        weights, moments = 0.0, 0.0
        for k in range(max(0, int(center - _WINDOW)), min(len(counts), int(center + _WINDOW) + 2)):
            weight = counts[k] * max(0.0, 1.0 - abs(k - center) / _WINDOW)
            weights += weight
            moments += weight * k
        if weights == 0.0:
            break
        moved, center = center, moments / weights
        agreement[channel] = weights / total
        if abs(moved - center) < _CLOSE:
            break
    change[channel] = _STEP * (center - _HALF)


@njit(cache=True, nogil=True)
def _compare(image, key, stride, log, now, change, comparable, agreement):  # type: ignore[no-untyped-def]
    """Sample the new frame and compare it with the key.

    Outputs for each channel: most frequent logarithmic ratio, number of comparable pixels, and share that agrees.
    """
    counts = np.zeros((3, 2 * _HALF + 1), np.int64)
    for row in range(now.shape[0]):
        for column in range(now.shape[1]):
            for channel in range(3):
                before = np.int64(key[row, column, channel])
                value = np.int64(image[row * stride, column * stride, channel])
                now[row, column, channel] = value
                if before == 0 or value == 0 or before + value < 2 * _DARK or max(before, value) >= _BRIGHT:
                    continue
                at = np.int64(np.rint((log[value] - log[before]) * np.float32(1.0 / _STEP))) + _HALF
                if 0 <= at <= 2 * _HALF:
                    counts[channel, at] += 1
    for channel in range(3):
        _most_frequent(counts[channel], channel, change, comparable, agreement)


@njit(cache=True, nogil=True)
def _relight(image, gains, out):  # type: ignore[no-untyped-def]
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            for channel in range(3):
                value = gains[channel] * np.float32(image[row, column, channel]) + np.float32(0.5)
                out[row, column, channel] = np.uint8(min(value, np.float32(255.0)))
