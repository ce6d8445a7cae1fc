"""Absorption of foreground that has not moved at all: things that were moved, left or uncovered."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import FloatArray


class StillRules(NamedTuple):
    """Conditions under which a region is a thing that does not move.

    Attributes:
        small_time: Time after which a region too small for a person is absorbed, s. Raising it keeps motionless parts
            of people longer, and moved things, too.
        time: Time after which any region is absorbed, s. People who breathe and sway do not stay that still; rendered
            ones may.
        small: Largest height of a small region, in heights of a person at its place.
        share: Smallest share of a region's outline that has not changed.
        every: Number of searches for ghosts between two searches for things that do not move.
        tolerance: Largest change of brightness that counts as none, as a share of the threshold of foreground.
    """

    small_time: float = 5.0
    time: float = 60.0
    small: float = 0.5
    share: float = 0.8
    every: int = 2
    tolerance: float = 0.5


class Stillness(NamedTuple):
    """Memory of the foreground's content.

    Attributes:
        level: Running mean of the brightness since it last changed, gray levels. Shape (H, W), float32.
        age: Time since the brightness of a foreground pixel last changed, s; 0 on the background. Shape (H, W),
            float32.
        passed: Time since the memory was last updated, s.
    """

    level: FloatArray
    age: FloatArray
    passed: float


def no_stillness(height: int, width: int) -> Stillness:
    """Return the memory before the first frame."""
    return Stillness(np.zeros((height, width), np.float32), np.zeros((height, width), np.float32), 0.0)


@njit(cache=True, nogil=True)
def absorb_still_regions(image, background, runs, boxes, heights, level, age, passed, dt, threshold, rules):  # type: ignore[no-untyped-def]
    """Follow the content of the foreground; copy regions that do not move into the background, in place.

    Args:
        image: The frame. Shape (H, W, C), uint8.
        background: The background. Shape (H, W, C), float32; changed.
        runs: Runs of the regions from `label_runs`; the index of absorbed runs becomes -1.
        boxes: Boxes of the regions. Shape (k, 4), px.
        heights: Height of a person at the place of each region, px; 0 where unknown. Shape (k,).
        level: `Stillness.level`; changed.
        age: `Stillness.age` at the last call; changed.
        passed: Time since the last call, s.
        dt: Time since the frame before, s: the age of what is new.
        threshold: Difference from which a pixel is foreground, gray levels.
        rules: A `StillRules`.

    Returns:
        Number of absorbed regions.
    """
    channels, regions = image.shape[2], boxes.shape[0]
    ends, still = np.zeros(regions), np.zeros(regions)
    limits = np.empty(regions)
    for k in range(regions):
        limits[k] = rules.small_time if boxes[k, 3] < rules.small * heights[k] else rules.time
    fresh = np.zeros_like(age)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k < 0:
            continue
        for column in range(first, stop):
            total = 0.0
            for channel in range(channels):
                total += image[row, column, channel]
            change = total / channels - level[row, column]
            if abs(change) < rules.tolerance * threshold and age[row, column] > 0:
                fresh[row, column] = age[row, column] + passed
                level[row, column] += 0.25 * change
            else:
                fresh[row, column] = dt
                level[row, column] += change
        ends[k] += 2.0
        still[k] += (fresh[row, first] > limits[k]) + (fresh[row, stop - 1] > limits[k])
    absorbed = 0
    gone = np.zeros(regions, np.bool_)
    for k in range(regions):
        gone[k] = ends[k] > 0.0 and still[k] >= rules.share * ends[k]
        absorbed += gone[k]
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k < 0 or not gone[k]:
            continue
        for y in range(max(row - 2, 0), min(row + 3, image.shape[0])):
            for column in range(max(first - 2, 0), min(stop + 2, image.shape[1])):
                for channel in range(channels):
                    background[y, column, channel] = image[y, column, channel]
        fresh[row, first:stop] = 0
        runs[n, 3] = -1
    age[:] = fresh
    return absorbed
