"""A second, lower threshold for people who wear the background's colors, where it can only help one person."""

from __future__ import annotations

import numpy as np
from numba import njit

_SLENDER = 0.65  # widest region, in its heights, that is one upright person
_SEEDS = 12.0  # px above the upper threshold that a region must hold


@njit(cache=True, nogil=True)
def add_faint_regions(mask, runs, boxes):  # type: ignore[no-untyped-def]
    """Fill faint regions that hold clear foreground into the mask, in place, as long as they are slender.

    Plain hysteresis joins people and their shadows to wide regions; slender ones join the parts of one person. A faint
    region without clear foreground is noise, shadow or flicker.

    Args:
        mask: Clear foreground, 0 or 255. Shape (H, W), uint8; changed.
        runs: Of the faint regions, as `label_runs` gives them.
        boxes: Of the faint regions. Shape (k, 4), px.
    """
    seeds = np.zeros(boxes.shape[0])
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if boxes[k, 2] <= _SLENDER * boxes[k, 3]:
            for column in range(first, stop):
                seeds[k] += mask[row, column] != 0
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if seeds[k] >= _SEEDS:
            mask[row, first:stop] = 255
