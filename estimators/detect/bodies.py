"""How tall people are at each row of an image, learned from regions that look like one person, and what it is for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

BANDS = 24


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
    known, intercept, slope = _fit(sizes.heights, sizes.counts, rows)
    return (intercept, slope) if known else None


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
            step = min(max(height - heights[band], -0.15 * heights[band]), 0.15 * heights[band])
            heights[band] += step * max(1.0 / counts[band], 0.02)


@njit(cache=True, nogil=True)
def _fit(heights, counts, rows):  # type: ignore[no-untyped-def]
    """Weighted straight line through the bands, twice, outliers down-weighted the second time."""
    if counts.sum() < 60.0:
        return False, 0.0, 0.0
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
    return True, intercept, slope


class Cover(NamedTuple):
    """Constants of the explanation of a region by bodies."""

    core: float = 0.2
    penalty: float = 0.25
    below: float = 0.5
    share: float = 0.25
    score: float = 0.15
    wide: float = 0.5
    tall: float = 1.2
    least: float = 0.05
    gap: float = 0.4


def find_bodies(runs, boxes, shape, intercept, slope, cover=Cover()):
    return _find(runs, boxes, shape[0], shape[1], intercept, slope, *cover)


@njit(cache=True, nogil=True)
def _height(row, intercept, slope):  # type: ignore[no-untyped-def]
    return max(intercept + slope * row, 10.0)


@njit(cache=True, nogil=True)
def _join(boxes, group, intercept, slope, gap, tall):  # type: ignore[no-untyped-def]
    """Groups of regions that stand one above the other within one body; boxes become those of the groups."""
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
def _window(integral, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    x0, x1 = min(max(x0, 0), columns), min(max(x1, 0), columns)
    y0, y1 = min(max(y0, 0), rows), min(max(y1, 0), rows)
    return integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]


@njit(cache=True, nogil=True)
def _explain(pixels, left, top, rows, columns, intercept, slope, core, penalty, below, share, score):  # type: ignore[no-untyped-def]
    """Bodies that explain a region, greedily.

    pixels: 1 on the region, 0 elsewhere; becomes 2 where a body stands."""
    h, w = pixels.shape
    found = np.empty((12, 4))
    count = 0
    fresh, ground = np.zeros((h + 1, w + 1), np.int32), np.zeros((h + 1, w + 1), np.int32)
    while count < 12:
        for y in range(h):
            line_fresh, line_ground = 0, 0
            for x in range(w):
                line_fresh += pixels[y, x] == 1
                line_ground += pixels[y, x] != 0
                fresh[y + 1, x + 1] = fresh[y, x + 1] + line_fresh
                ground[y + 1, x + 1] = ground[y, x + 1] + line_ground
        best, best_x, best_foot = -1.0, 0, 0
        smallest = int(0.4 * _height(top + h, intercept, slope))
        for foot in range(min(smallest, h), h + 1):
            height = _height(top + foot, intercept, slope)
            tall, half = int(round(height)), max(int(round(core * height / 2)), 1)
            head = max(foot - tall, -top)
            area = 2 * half * (foot - head)
            for x in range(min(half, w // 2), max(w - half, w // 2) + 1):
                new = _window(fresh, x - half, head, x + half, foot)
                if new < share * area:
                    continue
                empty = area - _window(ground, x - half, head, x + half, foot)
                strip = max(tall // 6, 1)
                under = _window(fresh, x - half, foot, x + half, foot + strip)
                value = (new - penalty * empty - below * under) / (2 * half * tall)
                if value > best:
                    best, best_x, best_foot = value, x, foot
        if best < score:
            break
        height = _height(top + best_foot, intercept, slope)
        width = 0.36 * height
        found[count, 0], found[count, 1] = left + best_x - width / 2, top + best_foot - height
        found[count, 2], found[count, 3] = width, height
        count += 1
        half, head = int(round(0.23 * height)), int(round(best_foot - height))
        for y in range(max(head, 0), min(best_foot + 2, h)):
            for x in range(max(best_x - half, 0), min(best_x + half, w)):
                if pixels[y, x] == 1:
                    pixels[y, x] = 2
    return found[:count]


@njit(cache=True, nogil=True)
def _find(runs, boxes, rows, columns, intercept, slope, core, penalty, below, share, score, wide, tall, least, gap):  # type: ignore[no-untyped-def]
    k = boxes.shape[0]
    group = np.arange(k)
    boxes = boxes.copy()
    _join(boxes, group, intercept, slope, gap, tall)
    for i in range(k):
        while group[group[i]] != group[i]:
            group[i] = group[group[i]]
    total = 0
    for n in range(runs.shape[0]):
        if runs[n, 3] >= 0:
            runs[n, 3] = group[runs[n, 3]]
            total += runs[n, 2] - runs[n, 1]
    out_runs = np.empty((total, 4), np.int32)
    out_boxes = np.empty((12 * k + 1, 4))
    out_runs_count, out_count = 0, 0
    for i in range(k):
        if group[i] != i:
            continue
        left, top, width, height = boxes[i]
        expected = _height(top + height, intercept, slope)
        bodies = np.empty((0, 4))
        x0, y0 = int(left), int(top)
        if width > wide * expected or height > tall * expected:
            pixels = np.zeros((int(height), int(width)), np.uint8)
            for n in range(runs.shape[0]):
                if runs[n, 3] == i:
                    pixels[runs[n, 0] - y0, runs[n, 1] - x0 : runs[n, 2] - x0] = 1
            bodies = _explain(pixels, x0, y0, rows, columns, intercept, slope, core, penalty, below, share, score)
        if bodies.shape[0] < 2:
            for n in range(runs.shape[0]):
                if runs[n, 3] == i:
                    out_runs[out_runs_count, :3] = runs[n, :3]
                    out_runs[out_runs_count, 3] = out_count
                    out_runs_count += 1
            out_boxes[out_count] = boxes[i]
            out_count += 1
            continue
        for n in range(runs.shape[0]):
            if runs[n, 3] != i:
                continue
            owner, start = -1, runs[n, 1]
            for x in range(runs[n, 1], runs[n, 2]):
                nearest, least_distance = 0, 1e18
                for b in range(bodies.shape[0]):
                    dx = abs(x + 0.5 - bodies[b, 0] - bodies[b, 2] / 2) / bodies[b, 2]
                    dy = abs(runs[n, 0] + 0.5 - bodies[b, 1] - bodies[b, 3] / 2) / bodies[b, 3]
                    distance = max(dx, dy)
                    if distance < least_distance:
                        nearest, least_distance = b, distance
                if nearest != owner:
                    if owner >= 0:
                        out_runs[out_runs_count] = runs[n]
                        out_runs[out_runs_count, 1], out_runs[out_runs_count, 2] = start, x
                        out_runs[out_runs_count, 3] = out_count + owner
                        out_runs_count += 1
                    owner, start = nearest, x
            out_runs[out_runs_count] = runs[n]
            out_runs[out_runs_count, 1] = start
            out_runs[out_runs_count, 3] = out_count + owner
            out_runs_count += 1
        out_boxes[out_count : out_count + bodies.shape[0]] = bodies
        out_count += bodies.shape[0]
    return out_runs[:out_runs_count], out_boxes[:out_count], group
