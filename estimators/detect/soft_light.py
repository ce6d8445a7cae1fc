"""Foreground without an edge of its own: reflections, highlights and soft shadows.

Light changes the gain of a surface: the ratio of frame and background is smooth, whatever the texture of the surface.
An object covers the surface, so that the ratio jumps at its outline.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit


class SoftLightRules(NamedTuple):
    """Conditions under which foreground is light.

    Attributes:
        reach: Number of pixels that are averaged on either side of an edge.
        floor: Gray level added to numerator and denominator of a gain, so that noise of dark surfaces is no gain.
        strong: Gain, or its inverse, beyond which a change is no reflection and no shadow. Raising it removes more.
        slender: Ratio of width to height up to which a region may be one person. Cast shadows are removed from wider
            regions only.
        darkest, lightest: Range of the gain of a shadow.
        uneven: Largest difference of a shadow's gain between the channels. Raising it takes more things for shadows.
    """

    reach: int = 3
    floor: float = 4.0
    strong: float = 1.5
    slender: float = 0.55
    darkest: float = 0.4
    lightest: float = 0.95
    uneven: float = 0.12


@njit(cache=True, nogil=True)
def trim_soft_light(image, known, background, runs, regions, mask, threshold, share, rate, rules):  # type: ignore[no-untyped-def]
    """Remove soft light from regions whose outline is mostly not an edge, in place.

    From each end of a run, pixels are removed up to the first edge of the gain. A reflection disappears as a whole; of
    a person in a soft shadow the person is left.

    Args:
        image: The frame. Shape (H, W, C), uint8.
        known: The background, rounded. Shape (H, W, C), uint8.
        background: The background, which learns the removed pixels. Shape (H, W, C), float32; changed.
        runs: Runs of the regions from `label_runs`; shortened, and the index of runs without a pixel becomes -1.
        regions: Number of regions.
        mask: Foreground, shape (H, W), uint8; changed.
        threshold: Difference from which a pixel is foreground, gray levels. An edge is a jump of the gain by what is
            half as much there.
        share: Smallest share of the outline's points that are edges for a region to stay as it is.
        rate: Weight of the frame where the background learns.
        rules: A `SoftLightRules`.

    Returns:
        Number of removed pixels.
    """
    width, reach = image.shape[1], rules.reach
    points, edges = np.zeros(regions), np.zeros(regions)
    lefts, rights = np.full(regions, width), np.zeros(regions, np.int64)
    tops, feet = np.full(regions, mask.shape[0]), np.zeros(regions, np.int64)
    least = 0.5 * threshold * reach
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k < 0:
            continue
        lefts[k], rights[k] = min(lefts[k], first), max(rights[k], stop)
        tops[k], feet[k] = min(tops[k], row), row + 1
        for end in range(2):
            column = first if end == 0 else stop
            if reach <= column <= width - reach:
                points[k] += 1.0
                edges[k] += _is_edge(image, known, row, column, end == 0, least, rules)
    removed = 0
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if k < 0:
            continue
        soft = edges[k] < share * points[k]
        wide = rights[k] - lefts[k] > rules.slender * (feet[k] - tops[k])
        if not (soft or wide):
            continue
        left, right = first, stop
        while left < stop and (
            (wide and is_shadow(image, known, row, left, min(left + reach, stop), rules))
            or (soft and (left < reach or not _is_edge(image, known, row, left, True, least, rules)))
        ):
            left += 1
        while right > left and (
            (wide and is_shadow(image, known, row, max(right - reach, first), right, rules))
            or (soft and (right > width - reach or not _is_edge(image, known, row, right, False, least, rules)))
        ):
            right -= 1
        for column in range(first, stop):
            if left <= column < right:
                continue
            mask[row, column] = 0
            removed += 1
            for channel in range(image.shape[2]):
                before = background[row, column, channel]
                background[row, column, channel] = before + rate * (image[row, column, channel] - before)
        runs[n, 1], runs[n, 2] = left, right
        if left == right:
            runs[n, 3] = -1
    return removed


@njit(cache=True, nogil=True)
def _is_edge(image, background, row, column, inward, least, rules):  # type: ignore[no-untyped-def]
    """Return True if the gain jumps at the left border of a column; `inward` if the foreground is right of it."""
    reach, floor = rules.reach, rules.floor * rules.reach
    if column > image.shape[1] - reach:
        return False
    for channel in range(image.shape[2]):
        before = after = known_before = known_after = 0.0
        for offset in range(reach):
            before += image[row, column - 1 - offset, channel]
            after += image[row, column + offset, channel]
            known_before += background[row, column - 1 - offset, channel]
            known_after += background[row, column + offset, channel]
        left, right = (before + floor) / (known_before + floor), (after + floor) / (known_after + floor)
        inside = right if inward else left
        # The jump in gray levels of the mean background.
        if abs(left - right) * 0.5 * (known_before + known_after) >= least:
            return True
        if inside > rules.strong or inside * rules.strong < 1.0:
            return True
    return False


@njit(cache=True, nogil=True)
def is_shadow(image, known, row, start, stop, rules):  # type: ignore[no-untyped-def]
    """Return True if all channels of some neighbors in a row are darker by about the same factor.

    Args:
        image: The frame. Shape (H, W, C), uint8.
        known: The background. Shape (H, W, C), uint8.
        row: Row of the pixels.
        start: First column.
        stop: Column after the last.
        rules: A `SoftLightRules`.
    """
    low, high = np.inf, 0.0
    for channel in range(image.shape[2]):
        one, two = rules.floor, rules.floor
        for column in range(start, stop):
            one += image[row, column, channel]
            two += known[row, column, channel]
        low, high = min(low, one / two), max(high, one / two)
    return low > rules.darkest and high < rules.lightest and high - low < rules.uneven
