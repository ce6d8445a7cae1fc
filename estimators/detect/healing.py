"""Detection and correction of permanent errors of a masked background: ghosts and changed light.

The update of Wu and Hu 2010, equation (6), never learns under foreground. So two kinds of foreground that are not
people never disappear:

* *Ghosts*: a person stood in the first frame and left. The outline of the region is an edge in the background but not
  in the frame; for people, also those who stand still, it is the other way round.
* *Light* that changed by more than the threshold. Over a large region the frame is the background times a gain plus an
  offset, channel by channel, so that the texture of the floor remains visible: differences of neighboring pixels are
  correlated between frame and background. People hide the texture, and people within the region do not fit the gain
  and offset and stay foreground. (Without any texture, light cannot be distinguished from a person in plain clothes,
  and nothing is healed.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit


class HealingRules(NamedTuple):
    """Conditions under which a region is a ghost or changed light.

    Attributes:
        reach: Number of pixels that are averaged on either side of an outline, at least 1.
        ghost_ratio: Smallest ratio of the edge in the background to that in the frame for a ghost. Raising it heals
            fewer regions.
        light_correlation: Smallest correlation of neighbors' differences between frame and background for changed
            light. Raising it heals fewer regions.
        lag: Distance of the neighbors whose difference is texture, px.
        light_area: Smallest region that is tested for changed light, as a share of the image.
    """

    reach: int = 3
    ghost_ratio: float = 2.0
    light_correlation: float = 0.6
    lag: int = 6
    light_area: float = 0.02


@njit(cache=True, nogil=True)
def heal_regions(image, background, runs, regions, threshold, rules):  # type: ignore[no-untyped-def]
    """Correct the background under ghosts and under changed light, in place, and remove them from the runs.

    Args:
        image: The frame. Shape (H, W, C), uint8.
        background: The background. Shape (H, W, C), float32, gray levels; changed.
        runs: Runs of the foreground's regions from `label_runs`; the index of healed runs becomes -1.
        regions: Number of regions.
        threshold: Difference from which a pixel is foreground, gray levels.
        rules: A `HealingRules`.

    Returns:
        Number of healed regions.
    """
    reach, lag = rules.reach, rules.lag
    least_light = rules.light_area * (image.shape[0] * image.shape[1])
    channels = image.shape[2]
    areas = np.zeros(regions)
    here, before, points = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    both, seen_texture, known_texture = np.zeros(regions), np.zeros(regions), np.zeros(regions)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k < 0:
            continue
        areas[k] += stop - first
        for end in range(2):
            column = first if end == 0 else stop
            if column < reach or column > image.shape[1] - reach:
                continue
            points[k] += 1.0
            for channel in range(channels):
                seen, known = 0.0, 0.0
                for offset in range(reach):
                    seen += float(image[row, column + offset, channel]) - float(
                        image[row, column - 1 - offset, channel]
                    )
                    known += background[row, column + offset, channel] - background[row, column - 1 - offset, channel]
                here[k] += abs(seen)
                before[k] += abs(known)
        for column in range(first, stop - lag, 2):
            for channel in range(channels):
                one = float(image[row, column + lag, channel]) - float(image[row, column, channel])
                two = background[row, column + lag, channel] - background[row, column, channel]
                both[k] += one * two
                seen_texture[k] += one * one
                known_texture[k] += two * two
    ghost, light = np.zeros(regions, np.bool_), np.zeros(regions, np.bool_)
    healed = 0
    for k in range(regions):
        sharp = before[k] > 0.3 * threshold * reach * points[k]
        ghost[k] = points[k] > 0.0 and sharp and before[k] > rules.ghost_ratio * here[k]
        alike = both[k] > rules.light_correlation * np.sqrt(seen_texture[k] * known_texture[k])
        light[k] = not ghost[k] and areas[k] >= least_light and alike
        healed += ghost[k] or light[k]
    if healed == 0:
        return 0
    for k in range(regions):
        if light[k]:
            _follow_light(image, background, runs, k, threshold)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k >= 0 and ghost[k]:
            # A margin of two pixels is below the threshold and would be learned only slowly.
            for y in range(max(row - 2, 0), min(row + 3, image.shape[0])):
                for column in range(max(first - 2, 0), min(stop + 2, image.shape[1])):
                    for channel in range(channels):
                        background[y, column, channel] = image[y, column, channel]
        if k >= 0 and (ghost[k] or light[k]):
            runs[n, 3] = -1
    return healed


@njit(cache=True, nogil=True)
def _follow_light(image, background, runs, region, threshold):  # type: ignore[no-untyped-def]
    """Fit gain and offset of each channel over a region (three passes, outliers left out) and apply them."""
    channels = image.shape[2]
    gain, offset = np.ones(channels), np.zeros(channels)
    for iteration in range(3):
        for channel in range(channels):
            n = sb = si = sbb = sbi = 0.0
            for index in range(runs.shape[0]):
                row, first, stop, k = runs[index]
                if k != region:
                    continue
                for column in range(first, stop):
                    b, i = float(background[row, column, channel]), float(image[row, column, channel])
                    if iteration > 0 and abs(gain[channel] * b + offset[channel] - i) > threshold:
                        continue
                    n += 1.0
                    sb += b
                    si += i
                    sbb += b * b
                    sbi += b * i
            if n > 0.0:
                # Regularized toward a gain of 1 for a region of one color.
                spread, common = sbb - sb * sb / n + 25.0 * n, sbi - sb * si / n + 25.0 * n
                gain[channel] = min(max(common / spread, 0.3), 3.0)
                offset[channel] = (si - gain[channel] * sb) / n
    for index in range(runs.shape[0]):
        row, first, stop, k = runs[index]
        if k != region:
            continue
        for column in range(first, stop):
            worst = 0.0
            for channel in range(channels):
                moved = gain[channel] * background[row, column, channel] + offset[channel]
                background[row, column, channel] = min(max(moved, 0.0), 255.0)
                worst = max(worst, abs(float(image[row, column, channel]) - background[row, column, channel]))
            if worst < threshold:
                for channel in range(channels):
                    background[row, column, channel] = image[row, column, channel]
