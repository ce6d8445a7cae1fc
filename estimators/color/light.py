"""Light of a film: gains of the color channels since the first frame, and pictures and histograms under other gains.

The sensor is modeled as gain and saturation, min(255, gain * value). Gains in this form also describe light on
gamma-encoded values, white balance and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.color.contract import check_count, check_positive, check_shares, checked_frame
from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, Image

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


@dataclass(frozen=True)
class LightMeter:
    """Estimator of the light from whole frames.

    The change of a channel is the most frequent ratio of its pixels to those of an earlier frame, the key. Pixels on
    moving objects and edges have other ratios, which are no majority. Saturated and dark pixels are left out. The key
    is kept as long as most of its pixels agree, so that the error does not grow while the camera rests. A channel that
    cannot be compared changes as the others do.

    Attributes:
        samples: Approximate number of pixels that are compared. Raising it costs time and reduces noise.
        dark: Pixels whose mean in both frames is below this value are not compared. Raising it leaves out more noise.
        bright: Pixels that have this value in either frame are not compared.
        step: Width of a bin of logarithmic ratios.
        bins: Number of bins on each side of the ratio 1, which limits a change from frame to frame.
        window: Half width of the triangular window around the most frequent ratio, bins. Raising it averages more.
        few: Share of the samples that must be comparable.
        agreement: Share of the comparable samples, weighted by the window, below which the frame counts as another view
            that says nothing about the light. Raising it distrusts moving cameras and noise more.
        support: Share of the largest agreement so far below which the key is replaced. Raising it replaces it sooner.
        largest: Limit of the logarithm of gains.
    """

    samples: int = 1000
    dark: int = 24
    bright: int = 250
    step: float = 0.02
    bins: int = 120
    window: float = 8.0
    few: float = 0.02
    agreement: float = 0.12
    support: float = 0.5
    largest: float = 2.5

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        check_count(samples=self.samples, dark=self.dark, bright=self.bright, bins=self.bins)
        check_positive(step=self.step, window=self.window, largest=self.largest)
        check_shares(few=self.few, agreement=self.agreement, support=self.support)

    def initial(self, image: Image) -> Light:
        """Return the light of the first frame, whose gains are 1 by definition.

        Args:
            image: RGB, shape (H, W, 3), or gray, shape (H, W); uint8.

        Raises:
            ValueError: The image has another type or shape.
        """
        image = checked_frame(image)
        stride = self._stride(image)
        return Light(np.zeros(3), image[::stride, ::stride].copy(), np.zeros(3), 0.0)

    def next(self, light: Light, image: Image) -> Light:
        """Estimate the gains in the next frame.

        Args:
            light: Light of the last frame.
            image: RGB or gray, of the same height and width as the frames before, uint8.

        Raises:
            ValueError: The image has another type or shape.
        """
        image = checked_frame(image)
        stride = self._stride(image)
        grid = image[::stride, ::stride].shape
        if grid != light.key.shape:
            raise ValueError(
                f"image must have the height and width of the frames before it, got {image.shape[:2]}; resize it, or "
                "start again with initial(image)"
            )
        now, change, comparable, agreement = np.empty_like(light.key), np.zeros(3), np.zeros(3), np.zeros(3)
        counts = np.zeros((3, 2 * self.bins + 1), np.int64)
        _count(image, light.key, stride, _LOG, self.dark, self.bright, self.step, now, counts)
        _most_frequent(counts, self.window, self.step, change, comparable, agreement)
        least = max(self.few * now[..., 0].size, 1.0)
        everywhere = comparable.min() >= least
        if not everywhere:
            known = comparable >= least
            if not known.any():
                return light
            change[~known], agreement[~known] = change[known].mean(), agreement[known].min()
        if agreement.min() < self.agreement:
            # Another view: nothing is known about its light.
            return Light(light.gains, now, light.gains, 0.0)
        gains = np.minimum(np.maximum(light.key_gains + change, -self.largest), self.largest)
        support = float((comparable * agreement).min())
        if everywhere and support < self.support * light.support:
            return Light(gains, now, gains, 0.0)
        return light._replace(gains=gains, support=max(support, light.support))

    def _stride(self, image: Image) -> int:
        return max(1, int(np.sqrt(image.shape[0] * image.shape[1] / self.samples)))


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


@njit(cache=True, nogil=True)
def _count(image, key, stride, log, dark, bright, step, now, counts):  # type: ignore[no-untyped-def]
    """Sample the new frame and count the logarithmic ratios of comparable pixels by channel."""
    half, scale = counts.shape[1] // 2, np.float32(1.0 / step)
    for row in range(now.shape[0]):
        for column in range(now.shape[1]):
            for channel in range(3):
                before = np.int64(key[row, column, channel])
                value = np.int64(image[row * stride, column * stride, channel])
                now[row, column, channel] = value
                if before == 0 or value == 0 or before + value < 2 * dark or max(before, value) >= bright:
                    continue
                at = np.int64(np.rint((log[value] - log[before]) * scale)) + half
                if 0 <= at <= 2 * half:
                    counts[channel, at] += 1


@njit(cache=True, nogil=True)
def _most_frequent(counts, window, step, change, comparable, agreement):  # type: ignore[no-untyped-def]
    """Find the most frequent ratio of each channel by mean shift from the median, and the share that agrees."""
    bins = counts.shape[1]
    for channel in range(3):
        total, so_far, middle = counts[channel].sum(), 0, 0
        comparable[channel] = total
        while 2 * (so_far + counts[channel, middle]) < total:
            so_far += counts[channel, middle]
            middle += 1
        center = float(middle)
        for _ in range(10):
            weights, moments = 0.0, 0.0
            for k in range(max(0, int(center - window)), min(bins, int(center + window) + 2)):
                weight = counts[channel, k] * max(0.0, 1.0 - abs(k - center) / window)
                weights += weight
                moments += weight * k
            if weights == 0.0:
                break
            moved, center = center, moments / weights
            agreement[channel] = weights / total
            if abs(moved - center) < 0.01:
                break
        change[channel] = step * (center - bins // 2)


@njit(cache=True, nogil=True)
def _relight(image, gains, out):  # type: ignore[no-untyped-def]
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            for channel in range(3):
                value = gains[channel] * np.float32(image[row, column, channel]) + np.float32(0.5)
                out[row, column, channel] = np.uint8(min(value, np.float32(255.0)))
