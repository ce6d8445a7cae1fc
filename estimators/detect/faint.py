"""Hysteresis with a second, lower threshold for people in the background's colors, limited to single people."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit


class FaintRules(NamedTuple):
    """Conditions under which a faint region completes a person.

    Attributes:
        slender: Largest ratio of a region's width to its height. Raising it also admits regions of several people.
        seeds: Smallest number of pixels above the upper threshold in a region. Raising it admits fewer regions.
        fewest: Smallest number of such pixels in a region of a small person.
        whole: Share of a region's rows with such pixels from which the person is complete and nothing is added.
    """

    slender: float = 0.65
    seeds: int = 12
    fewest: int = 3
    whole: float = 0.8


@njit(cache=True, nogil=True)
def add_faint_regions(mask, runs, boxes, rules):  # type: ignore[no-untyped-def]
    """Fill faint regions that contain parts of a person into the mask, in place.

    Unrestricted hysteresis joins people and their shadows to wide regions, and makes all people wider. Here a faint
    region counts only if it is slender, so that it joins the parts of one person, and if rows between its top and
    bottom are missing. A region without clear foreground is noise, shadow or flicker.

    Args:
        mask: Clear foreground, 0 or 255. Shape (H, W), uint8; changed.
        runs: Runs of the faint regions from `label_runs`, in the order of the image.
        boxes: Boxes of the faint regions. Shape (k, 4), px.
        rules: A `FaintRules`.
    """
    regions = boxes.shape[0]
    seeds, rows, last = np.zeros(regions, np.int64), np.zeros(regions, np.int64), np.full(regions, -1)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n]
        if boxes[k, 2] > rules.slender * boxes[k, 3]:
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
        if seeds[k] >= rules.seeds and rows[k] < rules.whole * boxes[k, 3]:
            mask[row, first:stop] = 255


@njit(cache=True, nogil=True)
def join_by_faint_regions(runs, regions, faint_runs, boxes, rules):  # type: ignore[no-untyped-def]
    """Give the parts of the foreground that lie within one slender faint region the same index, in place.

    Unlike filling, this adds no pixels, so that boxes stay as tight as the clear foreground.

    Args:
        runs: Runs of the clear foreground from `label_runs`, in the order of the image; changed. A region that was
            joined to another is left without a pixel.
        regions: Number of regions of the clear foreground.
        faint_runs: Runs of the faint regions, which contain the clear foreground, in the order of the image.
        boxes: Boxes of the faint regions. Shape (k, 4), px.
        rules: A `FaintRules`, of which `slender` is used.
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
            if around >= 0 and boxes[around, 2] <= rules.slender * boxes[around, 3]:
                if first_within[around] < 0:
                    first_within[around] = k
                joined[k] = first_within[around]
        runs[n, 3] = joined[k]
