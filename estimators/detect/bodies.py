"""Heights of people by image row, learned from single people, and division of regions that contain several people."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.height_line import height_line
from servotrack.estimators.types import Array

BANDS = 24
"""Number of bands of rows in a `BodySizes`."""


class BodySizes(NamedTuple):
    """Heights of people by the row of their feet, in 24 equal bands of rows.

    Attributes:
        heights: Running quantile of the heights, 0 in a band without a person so far. Shape (24,), px.
        counts: Number of people in each band so far. Shape (24,).
    """

    heights: Array
    counts: Array


class Cover(NamedTuple):
    """Parameters of learning heights, joining parts and dividing regions; lengths in heights of a person at that row.

    Attributes:
        wide, tall: Width and height above which a region may be several people. Raising them divides fewer regions.
        gap: Largest gap between parts one above the other that are joined.
        core: Width of the bar, as high as a person, that is placed over a region to find a person.
        share: Smallest share of the bar's pixels that no other person explains.
        penalty: Cost of a pixel of the bar outside the region, relative to an unexplained pixel inside.
        below: Cost of an unexplained pixel below the feet; with it the person in front is found first.
        score: Smallest balance of these per pixel of the bar. Raising it finds fewer people in a region.
        aspect: Width of a person's box.
        reach: Pixels within this distance of a person's axis belong to the person.
        people: Largest number of people in one region.
        join_after: Number of people after which parts are joined.
        divide_after: Number of people after which regions are divided.
        quantile: Quantile of the observed heights in a band that counts as the height of a person. It is above one half
            because parts of people are missing more often than something is added.
        mass: Exponent of a person's pixels in the order in which people are found. 0: first the person whose bar is
            filled best; 1: first the person who explains most pixels, so that a near person is not taken for several
            far ones.
        first_row, last_row: Rows of the feet outside of which regions are not divided, px.
    """

    wide: float = 0.5
    tall: float = 1.2
    gap: float = 0.4
    core: float = 0.2
    share: float = 0.25
    penalty: float = 0.25
    below: float = 0.5
    score: float = 0.15
    aspect: float = 0.36
    reach: float = 0.23
    people: int = 12
    join_after: float = 15.0
    divide_after: float = 60.0
    quantile: float = 0.65
    mass: float = 1.0
    first_row: float = -np.inf
    last_row: float = np.inf


def no_sizes() -> BodySizes:
    """Return sizes without any person."""
    return BodySizes(np.zeros(BANDS), np.zeros(BANDS))


def learn_sizes(sizes: BodySizes, boxes: Array, areas: Array, shape: tuple[int, ...], cover: Cover) -> BodySizes:
    """Learn from the regions of a frame that have the shape of one whole person.

    Args:
        sizes: Sizes so far.
        boxes: Left, top, width and height of regions. Shape (k, 4), px.
        areas: Number of pixels of each region. Shape (k,), px.
        shape: Height and width of the image, px.
        cover: Parameters, of which `quantile` is used.
    """
    heights, counts = sizes.heights.copy(), sizes.counts.copy()
    _learn(heights, counts, boxes, areas, shape[0], shape[1], cover.quantile)
    return BodySizes(heights, counts)


def body_line(sizes: BodySizes, rows: int, cover: Cover) -> tuple[float, float] | None:
    """Height of a person as a linear function of the row of the feet, which holds above flat ground.

    Args:
        sizes: Sizes so far.
        rows: Height of the image, px.
        cover: Parameters, of which `join_after` is used.

    Returns:
        Height at row 0, px, and its growth per row; None before `join_after` people were seen.
    """
    if sizes.counts.sum() < cover.join_after:
        return None
    return _fit(sizes.heights, sizes.counts, rows)


@njit(cache=True, nogil=True)
def _learn(heights, counts, boxes, areas, rows, columns, quantile):  # type: ignore[no-untyped-def]
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
            # The step of a running quantile falls from half of the height to 2 % of it.
            step = heights[band] * max(0.5 / counts[band], 0.02)
            heights[band] += step * (quantile if height > heights[band] else quantile - 1.0)


@njit(cache=True, nogil=True)
def _fit(heights, counts, rows):  # type: ignore[no-untyped-def]
    """Iteratively reweighted line fit through the bands (three passes, outliers down-weighted from the second on)."""
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
        intercept, slope = height_line(n, sy, sh, syy, syh, rows, 1.0)
    return intercept, slope


def divisible(sizes: BodySizes, cover: Cover) -> bool:
    """Return True if enough people were seen to divide regions."""
    return bool(sizes.counts.sum() >= cover.divide_after)


class Bodies(NamedTuple):
    """People in the regions of a frame.

    Attributes:
        runs: Pixels of the regions, each assigned to one person: row, first column, column after the last, person;
            shape (n, 4), int32.
        boxes: Box of the region if it is one person, else a box of the expected size. Shape (k, 4), px.
        heights: Expected height of a person at the feet of each. Shape (k,), px.
    """

    runs: NDArray[np.int32]
    boxes: Array
    heights: Array


def find_bodies(runs: NDArray[np.int32], boxes: Array, line: tuple[float, float], cover: Cover) -> Bodies:
    """Join parts of people and divide regions of several.

    Args:
        runs: Pixels of the regions from `label_runs`; changed.
        boxes: Boxes of the regions. Shape (k, 4), px.
        line: Result of `body_line`.
        cover: Parameters.
    """
    return Bodies(*_find_bodies(runs, boxes, line, cover))


@njit(cache=True, nogil=True)
def _height(row, line):  # type: ignore[no-untyped-def]
    intercept, slope = line
    return max(intercept + slope * row, 10.0)


@njit(cache=True, nogil=True)
def _join(boxes, group, line, gap):  # type: ignore[no-untyped-def]
    """Group regions that lie one above the other within one person; `boxes` become those of the groups."""
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
                height = _height(foot, line)
                space = max(boxes[i, 1], boxes[j, 1]) - min(boxes[i, 1] + boxes[i, 3], boxes[j, 1] + boxes[j, 3])
                first, last = min(boxes[i, 0], boxes[j, 0]), max(boxes[i, 0] + boxes[i, 2], boxes[j, 0] + boxes[j, 2])
                if foot - top > 1.15 * height or space > gap * height or last - first > 0.6 * height:
                    continue
                group[j] = i
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = first, top, last - first, foot - top
                again = True


@njit(cache=True, nogil=True)
def _sum(integral, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Sum over columns x0 to x1 and rows y0 to y1; pixels outside the region count as 0."""
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    x0, x1 = min(max(x0, 0), columns), min(max(x1, 0), columns)
    y0, y1 = min(max(y0, 0), rows), min(max(y1, 0), rows)
    return integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]


@njit(cache=True, nogil=True)
def _explain(pixels, left, top, line, cover):  # type: ignore[no-untyped-def]
    """Boxes of the people that explain a region, found one after the other.

    `pixels` is 1 on the region and 0 elsewhere; the pixels of people that were found become 2.
    """
    core, share, penalty, below = cover.core, cover.share, cover.penalty, cover.below
    rows, columns = pixels.shape
    found = np.empty((cover.people, 4))
    fresh, region = np.zeros((rows + 1, columns + 1), np.int32), np.zeros((rows + 1, columns + 1), np.int32)
    stride = max(int(_height(top + rows, line)) // 32, 1)
    for count in range(cover.people):
        for y in range(rows):
            line_fresh, line_region = 0, 0
            for x in range(columns):
                line_fresh += pixels[y, x] == 1
                line_region += pixels[y, x] != 0
                fresh[y + 1, x + 1] = fresh[y, x + 1] + line_fresh
                region[y + 1, x + 1] = region[y, x + 1] + line_region
        best, best_x, best_foot = -1.0, 0, 0
        for foot in range(rows, min(int(0.4 * _height(top + rows, line)), rows) - 1, -stride):
            height = _height(top + foot, line)
            tall, half = int(height + 0.5), max(int(core * height / 2 + 0.5), 1)
            # The part of a person beyond the image's border has no cost.
            head = max(foot - tall, -top)
            area = 2 * half * (foot - head)
            for x in range(min(half, columns // 2), max(columns - half, columns // 2) + 1, stride):
                new = _sum(fresh, x - half, head, x + half, foot)
                if new < share * area:
                    continue
                empty = area - _sum(region, x - half, head, x + half, foot)
                under = _sum(fresh, x - half, foot, x + half, foot + max(tall // 6, 1))
                value = (new - penalty * empty - below * under) / (2 * half * tall)
                if value < cover.score:
                    continue
                if cover.mass > 0.0:
                    value *= (2 * half * tall) ** cover.mass
                if value > best:
                    best, best_x, best_foot = value, x, foot
        if best < 0.0:
            return found[:count]
        height = _height(top + best_foot, line)
        width = cover.aspect * height
        found[count, 0], found[count, 1] = left + best_x - width / 2, top + best_foot - height
        found[count, 2], found[count, 3] = width, height
        half, head = int(cover.reach * height + 0.5), best_foot - int(height + 0.5)
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
def _find_bodies(runs, boxes, line, cover):  # type: ignore[no-untyped-def]
    k = boxes.shape[0]
    group, boxes = np.arange(k), boxes.copy()
    _join(boxes, group, line, cover.gap)
    total = 0
    for n in range(runs.shape[0]):
        if runs[n, 3] >= 0:
            total += runs[n, 2] - runs[n, 1]
            while group[runs[n, 3]] != runs[n, 3]:
                runs[n, 3] = group[runs[n, 3]]
    # A run may be divided into single pixels.
    out_runs, out_boxes = np.empty((total, 4), np.int32), np.empty((cover.people * k, 4))
    written, people = 0, 0
    for i in range(k):
        if group[i] != i:
            continue
        left, top, width, height = boxes[i]
        x0, y0 = int(left), int(top)
        bodies = np.empty((0, 4))
        expected = _height(top + height, line)
        supported = cover.first_row <= top + height <= cover.last_row
        if supported and (width > cover.wide * expected or height > cover.tall * expected):
            pixels = np.zeros((int(height), int(width)), np.uint8)
            for n in range(runs.shape[0]):
                if runs[n, 3] == i:
                    pixels[runs[n, 0] - y0, runs[n, 1] - x0 : runs[n, 2] - x0] = 1
            bodies = _explain(pixels, x0, y0, line, cover)
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
        heights[b] = _height(out_boxes[b, 1] + out_boxes[b, 3], line)
    return out_runs[:written], out_boxes[:people], heights
