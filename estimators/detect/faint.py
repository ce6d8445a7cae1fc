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
