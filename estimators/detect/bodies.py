"""How tall people are at each row of an image, learned from regions that look like one person, and what it is for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from servotrack.estimators.types import Array

BANDS = 24
BODY_ASPECT = 0.36
"""Width of a person's box, in heights."""
_JOINED_FROM, _DIVIDED_FROM = 15.0, 60.0  # people seen
_QUANTILE = 0.65  # of the heights in a band: parts of people are more often missing than something is added
_MOST = 12  # people in one region
_REACH = 0.23  # pixels so near to a person's axis belong to the person, in heights


class BodySizes(NamedTuple):
    """Heights of people whose feet are in each of 24 equal bands of rows.

    Attributes:
        heights: Robust running mean, 0 in a band without a person so far. Shape (24,), px.
        counts: Number of people it rests on. Shape (24,).
    """

    heights: Array
    counts: Array


def no_sizes() -> BodySizes:
    """Nothing known yet."""
    return BodySizes(np.zeros(BANDS), np.zeros(BANDS))


def learn_sizes(sizes: BodySizes, boxes: Array, areas: Array, shape: tuple[int, ...]) -> BodySizes:
    """Learn from the regions of a frame that look like one whole person.

    Args:
        sizes: What is known.
        boxes: Left, top, width and height of regions. Shape (k, 4), px.
        areas: Their pixels. Shape (k,), px.
        shape: Height and width of the image, px.
    """
    heights, counts = sizes.heights.copy(), sizes.counts.copy()
    _learn(heights, counts, boxes, areas, shape[0], shape[1])
    return BodySizes(heights, counts)


def body_line(sizes: BodySizes, rows: int) -> tuple[float, float] | None:
    """The height of a person as a straight line over the row of the feet, as it is above flat ground.

    Args:
        sizes: What is known.
        rows: Height of the image, px.

    Returns:
        Height at row 0, px, and its growth per row; None before enough people were seen.
    """
    if sizes.counts.sum() < _JOINED_FROM:
        return None
    return _fit(sizes.heights, sizes.counts, rows)


@njit(cache=True, nogil=True)
def _learn(heights, counts, boxes, areas, rows, columns):  # type: ignore[no-untyped-def]
    for k in range(boxes.shape[0]):
        left, top, width, height = boxes[k]
        inside = left > 1 and top > 1 and left + width < columns - 1 and top + height < rows - 1
        upright = 0.2 * height <= width <= 0.55 * height
        if not (inside and upright and height >= 14.0 and areas[k] >= 0.4 * width * height):
            continue
        band = min(int((top + height) * BANDS / rows), BANDS - 1)
        counts[band] += 1.0
        if counts[band] == 1.0:
            heights[band] = height
        else:
            # The step of a running quantile, half of the height at first and one part in fifty in the end.
            step = heights[band] * max(0.5 / counts[band], 0.02)
            heights[band] += step * (_QUANTILE if height > heights[band] else _QUANTILE - 1.0)


@njit(cache=True, nogil=True)
def _fit(heights, counts, rows):  # type: ignore[no-untyped-def]
    """Weighted straight line through the bands, twice, outliers down-weighted the second time."""
    intercept, slope = 0.0, 0.0
    for iteration in range(3):
        n = sy = sh = syy = syh = 0.0
        for band in range(BANDS):
            if counts[band] == 0.0:
                continue
            y, h = (band + 0.5) * rows / BANDS, heights[band]
            weight = min(counts[band], 50.0)
            if iteration > 0:
                weight /= 1.0 + ((h - intercept - slope * y) / (0.1 * h)) ** 2
            n += weight
            sy += weight * y
            sh += weight * h
            syy += weight * y * y
            syh += weight * y * h
        # A little weight on "the same height everywhere" where all stand in one row.
        spread = syy - sy * sy / n + n * (0.02 * rows) ** 2
        slope = min(max((syh - sy * sh / n) / spread, 0.0), 1.0)
        intercept = (sh - slope * sy) / n
    return intercept, slope


def divisible(sizes: BodySizes) -> bool:
    """Whether heights are known well enough to divide regions; parts are joined with less."""
    return bool(sizes.counts.sum() >= _DIVIDED_FROM)


class Cover(NamedTuple):
    """When regions are joined and divided; lengths in heights of a person at that row.

    Attributes:
        wide, tall: Width and height above which a region may be several people.
        gap: Largest gap between parts that stand one above the other and are joined.
        core: Width of the bar, as high as a person, that is laid over a region to find one.
        share: Least share of the bar that no other person explains.
        penalty: What a pixel of the bar outside the region costs, against 1 for an unexplained one inside.
        below: What an unexplained pixel below the feet costs: who stands in front is found first.
        score: Least balance of these per pixel of the bar.
    """

    wide: float = 0.5
    tall: float = 1.2
    gap: float = 0.4
    core: float = 0.2
    share: float = 0.25
    penalty: float = 0.25
    below: float = 0.5
    score: float = 0.15


class Bodies(NamedTuple):
    """People in the regions of a frame.

    Attributes:
        runs: The regions' pixels, each given to one person: row, first column, column after the last, person; shape
            (n, 4), int32.
        boxes: Of a region that is one person its own, else as large as a person is there. Shape (k, 4), px.
        heights: How tall a person is expected to be at the feet of each. Shape (k,), px.
    """

    runs: NDArray[np.int32]
    boxes: Array
    heights: Array


def find_bodies(runs: NDArray[np.int32], boxes: Array, line: tuple[float, float], cover: Cover) -> Bodies:
    """Join parts of people and divide regions of several.

    Args:
        runs: The regions' pixels, as `label_runs` gives them; changed.
        boxes: The regions' boxes. Shape (k, 4), px.
        line: From `body_line`.
        cover: Constants.
    """
    return Bodies(*_find_bodies(runs, boxes, *line, *cover))


@njit(cache=True, nogil=True)
def _height(row, intercept, slope):  # type: ignore[no-untyped-def]
    return max(intercept + slope * row, 10.0)


@njit(cache=True, nogil=True)
def _join(boxes, group, intercept, slope, gap):  # type: ignore[no-untyped-def]
    """Groups of regions that lie one above the other within one person; `boxes` become those of the groups."""
    k = boxes.shape[0]
    again = True
    while again:
        again = False
        for i in range(k):
            if group[i] != i:
                continue
            for j in range(i + 1, k):
                if group[j] != j:
                    continue
                left, right = max(boxes[i, 0], boxes[j, 0]), min(boxes[i, 0] + boxes[i, 2], boxes[j, 0] + boxes[j, 2])
                if right - left < 0.4 * min(boxes[i, 2], boxes[j, 2]):
                    continue
                top, foot = min(boxes[i, 1], boxes[j, 1]), max(boxes[i, 1] + boxes[i, 3], boxes[j, 1] + boxes[j, 3])
                height = _height(foot, intercept, slope)
                space = max(boxes[i, 1], boxes[j, 1]) - min(boxes[i, 1] + boxes[i, 3], boxes[j, 1] + boxes[j, 3])
                first, last = min(boxes[i, 0], boxes[j, 0]), max(boxes[i, 0] + boxes[i, 2], boxes[j, 0] + boxes[j, 2])
                if foot - top > 1.15 * height or space > gap * height or last - first > 0.6 * height:
                    continue
                group[j] = i
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = first, top, last - first, foot - top
                again = True


@njit(cache=True, nogil=True)
def _sum(integral, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Sum over columns x0 to x1 and rows y0 to y1, what lies outside being 0."""
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    x0, x1 = min(max(x0, 0), columns), min(max(x1, 0), columns)
    y0, y1 = min(max(y0, 0), rows), min(max(y1, 0), rows)
    return integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]


@njit(cache=True, nogil=True)
def _explain(pixels, left, top, intercept, slope, core, share, penalty, below, score):  # type: ignore[no-untyped-def]
    """Boxes of the people that explain a region, found one after the other.

    `pixels` is 1 on the region, 0 elsewhere, and becomes 2 where somebody was found.
    """
    rows, columns = pixels.shape
    found = np.empty((_MOST, 4))
    fresh, region = np.zeros((rows + 1, columns + 1), np.int32), np.zeros((rows + 1, columns + 1), np.int32)
    stride = max(int(_height(top + rows, intercept, slope)) // 32, 1)
    for count in range(_MOST):
        for y in range(rows):
            line_fresh, line_region = 0, 0
            for x in range(columns):
                line_fresh += pixels[y, x] == 1
                line_region += pixels[y, x] != 0
                fresh[y + 1, x + 1] = fresh[y, x + 1] + line_fresh
                region[y + 1, x + 1] = region[y, x + 1] + line_region
        best, best_x, best_foot = -1.0, 0, 0
        for foot in range(rows, min(int(0.4 * _height(top + rows, intercept, slope)), rows) - 1, -stride):
            height = _height(top + foot, intercept, slope)
            tall, half = int(height + 0.5), max(int(core * height / 2 + 0.5), 1)
            # What the image's border cuts off is not counted against a person.
            head = max(foot - tall, -top)
            area = 2 * half * (foot - head)
            for x in range(min(half, columns // 2), max(columns - half, columns // 2) + 1, stride):
                new = _sum(fresh, x - half, head, x + half, foot)
                if new < share * area:
                    continue
                empty = area - _sum(region, x - half, head, x + half, foot)
                under = _sum(fresh, x - half, foot, x + half, foot + max(tall // 6, 1))
                value = (new - penalty * empty - below * under) / (2 * half * tall)
                if value > best:
                    best, best_x, best_foot = value, x, foot
        if best < score:
            return found[:count]
        height = _height(top + best_foot, intercept, slope)
        width = BODY_ASPECT * height
        found[count, 0], found[count, 1] = left + best_x - width / 2, top + best_foot - height
        found[count, 2], found[count, 3] = width, height
        half, head = int(_REACH * height + 0.5), best_foot - int(height + 0.5)
        for y in range(max(head, 0), min(best_foot + 2, rows)):
            for x in range(max(best_x - half, 0), min(best_x + half, columns)):
                if pixels[y, x] == 1:
                    pixels[y, x] = 2
    return found


@njit(cache=True, nogil=True)
def _nearest(x, y, bodies):  # type: ignore[no-untyped-def]
    nearest, least = 0, np.inf
    for b in range(bodies.shape[0]):
        across = abs(x + 0.5 - bodies[b, 0] - bodies[b, 2] / 2) / bodies[b, 2]
        along = abs(y + 0.5 - bodies[b, 1] - bodies[b, 3] / 2) / bodies[b, 3]
        if max(across, along) < least:
            nearest, least = b, max(across, along)
    return nearest


@njit(cache=True, nogil=True)
def _find_bodies(  # type: ignore[no-untyped-def]
    runs, boxes, intercept, slope, wide, tall, gap, core, share, penalty, below, score
):
    k = boxes.shape[0]
    group, boxes = np.arange(k), boxes.copy()
    _join(boxes, group, intercept, slope, gap)
    total = 0
    for n in range(runs.shape[0]):
        if runs[n, 3] >= 0:
            total += runs[n, 2] - runs[n, 1]
            while group[runs[n, 3]] != runs[n, 3]:
                runs[n, 3] = group[runs[n, 3]]
    # A run may fall apart into as many as it has pixels.
    out_runs, out_boxes = np.empty((total, 4), np.int32), np.empty((_MOST * k, 4))
    written, people = 0, 0
    for i in range(k):
        if group[i] != i:
            continue
        left, top, width, height = boxes[i]
        x0, y0 = int(left), int(top)
        bodies = np.empty((0, 4))
        expected = _height(top + height, intercept, slope)
        if width > wide * expected or height > tall * expected:
            pixels = np.zeros((int(height), int(width)), np.uint8)
            for n in range(runs.shape[0]):
                if runs[n, 3] == i:
                    pixels[runs[n, 0] - y0, runs[n, 1] - x0 : runs[n, 2] - x0] = 1
            bodies = _explain(pixels, x0, y0, intercept, slope, core, share, penalty, below, score)
        if bodies.shape[0] < 2:
            bodies = boxes[i : i + 1]
        for n in range(runs.shape[0]):
            if runs[n, 3] != i:
                continue
            row, start, stop = runs[n, 0], runs[n, 1], runs[n, 2]
            owner = _nearest(start, row, bodies)
            for x in range(start + 1, stop + 1):
                other = _nearest(x, row, bodies) if x < stop else -1
                if other != owner:
                    out_runs[written, 0], out_runs[written, 1], out_runs[written, 2] = row, start, x
                    out_runs[written, 3] = people + owner
                    written += 1
                    owner, start = other, x
        for b in range(bodies.shape[0]):
            for side in range(4):
                out_boxes[people, side] = bodies[b, side]
            people += 1
    heights = np.empty(people)
    for b in range(people):
        heights[b] = _height(out_boxes[b, 1] + out_boxes[b, 3], intercept, slope)
    return out_runs[:written], out_boxes[:people], heights
