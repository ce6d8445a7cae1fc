"""Where a masked background is wrong for ever: ghosts of people who left, and changed light; told apart and healed.

The update of paper 000, equation (6), never learns under foreground. Two kinds of foreground are not people and stay:

* *Ghosts*: somebody stood in the first frame and left. The region's outline is an edge in the background and none in
  the frame; with people it is the other way round, also with those who stand still.
* *Light* that changed by more than the threshold. Over a large region the frame is the background times a gain plus an
  offset, channel by channel, so that what is seen of the floor's texture is still seen: differences of neighbors are
  correlated between frame and background. People hide the texture, and those who stand in the light do not follow
  the line of gain and offset and stay foreground. (Where there is no texture at all, nothing tells light from a
  person in plain clothes, and nothing is healed.)
"""

from __future__ import annotations

import numpy as np
from numba import njit

_REACH = 3  # px to either side of an outline that are averaged
_GHOST_RATIO = 2.0  # how much stronger the edge must be in the background
_LIGHT_CORRELATION = 0.6  # least correlation of neighbors' differences between frame and background
_LAG = 6  # px between neighbors whose difference is texture


@njit(cache=True, nogil=True)
def heal_regions(image, background, runs, regions, threshold, least_light):  # type: ignore[no-untyped-def]
    """Correct the background under ghosts and under changed light, in place, and take them out of the runs.

    Args:
        image: Shape (H, W, C), uint8.
        background: Shape (H, W, C), float32, gray levels; changed.
        runs: Of the foreground's regions, as `label_runs` gives them; the number becomes -1 where healed.
        regions: Number of regions.
        threshold: Difference from which a pixel is foreground, gray levels.
        least_light: Least area of a region that is tested for a change of light, px.

    Returns:
        Number of regions that were healed.
    """
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
            if column < _REACH or column > image.shape[1] - _REACH:
                continue
            points[k] += 1.0
            for channel in range(channels):
                seen, known = 0.0, 0.0
                for offset in range(_REACH):
                    seen += float(image[row, column + offset, channel]) - float(
                        image[row, column - 1 - offset, channel]
                    )
                    known += background[row, column + offset, channel] - background[row, column - 1 - offset, channel]
                here[k] += abs(seen)
                before[k] += abs(known)
        for column in range(first, stop - _LAG, 2):
            for channel in range(channels):
                one = float(image[row, column + _LAG, channel]) - float(image[row, column, channel])
                two = background[row, column + _LAG, channel] - background[row, column, channel]
                both[k] += one * two
                seen_texture[k] += one * one
                known_texture[k] += two * two
    ghost, light = np.zeros(regions, np.bool_), np.zeros(regions, np.bool_)
    healed = 0
    for k in range(regions):
        sharp = before[k] > 0.3 * threshold * _REACH * points[k]
        ghost[k] = points[k] > 0.0 and sharp and before[k] > _GHOST_RATIO * here[k]
        alike = both[k] > _LIGHT_CORRELATION * np.sqrt(seen_texture[k] * known_texture[k])
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
            # A halo of two pixels lies below the threshold, and would be learned slowly.
            for y in range(max(row - 2, 0), min(row + 3, image.shape[0])):
                for column in range(max(first - 2, 0), min(stop + 2, image.shape[1])):
                    for channel in range(channels):
                        background[y, column, channel] = image[y, column, channel]
        if k >= 0 and (ghost[k] or light[k]):
            runs[n, 3] = -1
    return healed


@njit(cache=True, nogil=True)
def _follow_light(image, background, runs, region, threshold):  # type: ignore[no-untyped-def]
    """Fit gain and offset of each channel over a region, twice, and move the background along."""
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
                # Drawn to a gain of 1 where the region is of one color.
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
