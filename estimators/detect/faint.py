"""A second, lower threshold for people who wear the background's colors, where it can only help one person."""

from __future__ import annotations

import numpy as np
from numba import njit

_SLENDER = 0.65  # widest region, in its heights, that is one upright person
_SEEDS = 12  # px above the upper threshold that a region must hold
_WHOLE = 0.8  # share of a region's rows with such pixels from which nothing is missing


@njit(cache=True, nogil=True)
def add_faint_regions(mask, runs, boxes):  # type: ignore[no-untyped-def]
    """Fill faint regions that hold parts of a person into the mask, in place.

    Plain hysteresis joins people and their shadows to wide regions, and makes everybody wider. Here a faint region
    counts only where it is slender, so that it joins the parts of one person, and where something is missing between
    its top and its bottom. Without any clear foreground it is noise, shadow or flicker.

    Args:
        mask: Clear foreground, 0 or 255. Shape (H, W), uint8; changed.
        runs: Of the faint regions, as `label_runs` gives them, in the order of the image.
        boxes: Of the faint regions. Shape (k, 4), px.
    """
    regions = boxes.shape[0]
    seeds, rows, last = np.zeros(regions, np.int64), np.zeros(regions, np.int64), np.full(regions, -1)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if boxes[k, 2] > _SLENDER * boxes[k, 3]:
            continue
        clear = 0
        for column in range(first, stop):
            clear += mask[row, column] != 0
        seeds[k] += clear
        if clear > 0 and last[k] != row:
            rows[k] += 1
            last[k] = row
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if seeds[k] >= _SEEDS and rows[k] < _WHOLE * boxes[k, 3]:
            mask[row, first:stop] = 255


@njit(cache=True, nogil=True)
def join_by_faint_regions(runs, regions, faint_runs, boxes):  # type: ignore[no-untyped-def]
    """Give the parts of the foreground that lie within one slender faint region one number, in place.

    Unlike filling, this leaves the pixels as they are, and so the boxes as tight as the clear foreground.

    Args:
        runs: Of the clear foreground, as `label_runs` gives them, in the order of the image; changed. A number that
            was joined to another is left without a pixel.
        regions: Number of its regions.
        faint_runs: Of the faint regions, which contain the clear foreground, likewise.
        boxes: Of the faint regions. Shape (k, 4), px.
    """
    first_within = np.full(boxes.shape[0], -1)
    joined = np.full(regions, -1)
    f = 0
    for n in range(runs.shape[0]):
        row, column, _, k = runs[n]
        if joined[k] < 0:
            while f < faint_runs.shape[0] and (
                faint_runs[f, 0] < row or (faint_runs[f, 0] == row and faint_runs[f, 2] <= column)
            ):
                f += 1
            around = faint_runs[f, 3] if f < faint_runs.shape[0] else -1
            joined[k] = k
            if around >= 0 and boxes[around, 2] <= _SLENDER * boxes[around, 3]:
                if first_within[around] < 0:
                    first_within[around] = k
                joined[k] = first_within[around]
        runs[n, 3] = joined[k]
