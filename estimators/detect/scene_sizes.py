"""Height of people by image row as one straight line, with a test of whether the scene supports it.

A region that is a part of a person has the shape of a small person. A count of regions takes such parts for people, and
the more regions it divides, the more parts there are. Here regions vote with their pixels: a fragment has few. The line
is used only if enough pixels agree with it, that is if people stand on flat ground in front of an upright camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.height_line import height_line
from servotrack.estimators.types import Array


class HeightTable(NamedTuple):
    """Layout of the table of heights in a `SceneSizes`.

    Attributes:
        bands: Number of bands of rows.
        levels: Number of classes of heights.
        lowest: Lower limit of the lowest class, px.
        ratio: Ratio of the limits of a class; the highest one ends at 582 px.
    """

    bands: int = 48
    levels: int = 48
    lowest: float = 6.0
    ratio: float = 1.1


TABLE = HeightTable()


class SceneRules(NamedTuple):
    """Parameters of the heights of a scene.

    Attributes:
        agree: Relative difference within which a height agrees with the line. Raising it accepts more scenes.
        support: Smallest share of pixels that agree among those of regions that are not smaller: fragments do not
            contradict the line, taller people do. Raising it accepts fewer scenes.
        presence: Smallest share of the pixels of all upright regions that agree.
        memory: Number of upright regions after which evidence has faded to 1/e.
        doubt: Number of upright regions after which a contradiction has faded to 1/e.
        contradiction: Share of upright regions from which dividing them shows that the line is wrong: a region with the
            shape of one person is rarely several. Raising it tolerates more divisions.
        refit: Growth of the number of regions after which the line is fitted again.
        sure: Number of upright regions from which it is said that regions are not divided, and of lying ones from which
            it is said that things do not stand upright.
        lying: Ratio of width to height from which a region lies.
        mostly: Number of lying regions per upright one from which things do not stand upright. Raising it tolerates
            more wide things.
        part: Smallest number of pixels of a person, as a share of those of a person who is entirely visible. Raising it
            removes more fragments.
        speck: The same before heights by place are known, relative to the typical person, and before people are known,
            relative to the largest region of the frame.
        far: People with a smaller expected height are left out, as a share of the typical height.
    """

    agree: float = 0.12
    support: float = 0.8
    presence: float = 0.4
    memory: float = 2000.0
    doubt: float = 100.0
    contradiction: float = 0.5
    refit: float = 1.02
    sure: float = 300.0
    lying: float = 1.3
    mostly: float = 2.0
    part: float = 0.25
    speck: float = 0.03
    far: float = 0.5


class SceneLine(NamedTuple):
    """Heights of people in a scene.

    Attributes:
        intercept: Height of a person whose feet are at row 0, px; may be negative.
        slope: Growth of the height per row of the feet.
        agreement: Share of pixels that agree with the line among those of regions that are not smaller.
        presence: Share of the pixels of all upright regions that agree with the line.
        typical: Median height of upright regions, weighted by pixels, px.
        first_row, last_row: Rows of the feet between which heights were seen, px.
    """

    intercept: float
    slope: float
    agreement: float
    presence: float
    typical: float
    first_row: float
    last_row: float


class SceneSizes(NamedTuple):
    """Evidence on the heights of people by the row of their feet.

    Attributes:
        pixels: Pixels of upright regions by row of the feet and by height. Shape (48, 48).
        seen: Number of upright regions so far.
        upright: Decaying number of upright regions since heights are known.
        divided: Decaying number of those that are taller than one person may be.
        line: Heights by row that follow from `pixels`; None before the first region.
        fitted: Number of upright regions at the last fit of the line.
        lying: Number of regions so far that are wider than they are tall.
    """

    pixels: Array
    seen: float
    upright: float
    divided: float
    line: SceneLine | None
    fitted: float
    lying: float


def no_scene_sizes() -> SceneSizes:
    """Return the state before the first region."""
    return SceneSizes(np.zeros((TABLE.bands, TABLE.levels)), 0.0, 0.0, 0.0, None, 0.0, 0.0)


def learn_scene(sizes: SceneSizes, boxes: Array, areas: Array, shape: tuple[int, ...], rules: SceneRules) -> SceneSizes:
    """Learn from the regions of a frame that have the shape of one whole person.

    Args:
        sizes: State so far.
        boxes: Left, top, width and height of regions before any division. Shape (k, 4), px.
        areas: Number of pixels of each region. Shape (k,).
        shape: Height and width of the image, px.
        rules: Parameters, of which `memory`, `agree`, `refit` and `lying` are used.
    """
    lying = _count_lying(boxes, areas, shape[0], shape[1], rules.lying)
    if lying:
        sizes = sizes._replace(lying=sizes.lying + lying)
    pixels = sizes.pixels.copy()
    count = _learn(pixels, boxes, areas, shape[0], shape[1], rules.memory)
    if not count:
        return sizes
    seen, line, fitted = sizes.seen + count, sizes.line, sizes.fitted
    if line is None or seen >= rules.refit * fitted:
        line, fitted = SceneLine(*_fit(pixels, shape[0], rules.agree)), seen
    return sizes._replace(pixels=pixels, seen=seen, line=line, fitted=fitted)


def supported(sizes: SceneSizes, rules: SceneRules | None) -> bool:
    """Return True if enough of the scene agrees with the line."""
    line = sizes.line
    return (
        rules is not None and line is not None and line.agreement >= rules.support and line.presence >= rules.presence
    )


def lies(sizes: SceneSizes, rules: SceneRules) -> bool:
    """Return True if most things in the scene are wider than they are tall, as people are in a turned picture."""
    return sizes.lying >= max(rules.sure, rules.mostly * sizes.seen)


def contradicted(sizes: SceneSizes, rules: SceneRules) -> float:
    """Return the share of upright regions that are taller than one person may be, 0 to 1; 0 for too few regions."""
    return sizes.divided / sizes.upright if sizes.upright > rules.doubt / 4.0 else 0.0


def judge_line(
    sizes: SceneSizes, boxes: Array, areas: Array, shape: tuple[int, ...], tall: float, rules: SceneRules
) -> SceneSizes:
    """Count the upright regions that contradict the line.

    Args:
        sizes: State with a line.
        boxes: Left, top, width and height of regions before any division. Shape (k, 4), px.
        areas: Number of pixels of each region. Shape (k,).
        shape: Height and width of the image, px.
        tall: Height above which a region is divided, in heights of a person.
        rules: Parameters, of which `doubt` is used.
    """
    assert sizes.line is not None
    line = (sizes.line.intercept, sizes.line.slope)
    count, taller = _count_taller(boxes, areas, shape[0], shape[1], line, tall)
    if not count:
        return sizes
    fading = float(np.exp(-count / rules.doubt))
    return sizes._replace(upright=fading * sizes.upright + count, divided=fading * sizes.divided + taller)


@njit(cache=True, nogil=True)
def _is_upright(box, area, rows, columns):  # type: ignore[no-untyped-def]
    """Return True for a region inside the image with the shape of one person."""
    left, top, width, height = box
    inside = left > 1 and top > 1 and left + width < columns - 1 and top + height < rows - 1
    return inside and 0.2 * height <= width <= 0.55 * height and height >= TABLE.lowest and area >= 0.4 * width * height


@njit(cache=True, nogil=True)
def _count_lying(boxes, areas, rows, columns, ratio):  # type: ignore[no-untyped-def]
    """Number of solid regions inside the image that are wider than they are tall by a ratio."""
    count = 0
    for k in range(boxes.shape[0]):
        left, top, width, height = boxes[k]
        inside = left > 1 and top > 1 and left + width < columns - 1 and top + height < rows - 1
        solid = height >= TABLE.lowest and areas[k] >= 0.4 * width * height
        count += inside and solid and width >= ratio * height
    return count


@njit(cache=True, nogil=True)
def _learn(pixels, boxes, areas, rows, columns, memory):  # type: ignore[no-untyped-def]
    """Add the upright regions of a frame to the evidence and let earlier ones fade; return their number."""
    count = 0
    for k in range(boxes.shape[0]):
        count += _is_upright(boxes[k], areas[k], rows, columns)
    if count == 0:
        return 0
    fading = np.exp(-count / memory)
    for band in range(TABLE.bands):
        for level in range(TABLE.levels):
            pixels[band, level] *= fading
    for k in range(boxes.shape[0]):
        if _is_upright(boxes[k], areas[k], rows, columns):
            band = min(int((boxes[k, 1] + boxes[k, 3]) * TABLE.bands / rows), TABLE.bands - 1)
            level = min(int(np.log(boxes[k, 3] / TABLE.lowest) / np.log(TABLE.ratio)), TABLE.levels - 1)
            pixels[band, level] += areas[k]
    return count


@njit(cache=True, nogil=True)
def _count_taller(boxes, areas, rows, columns, line, tall):  # type: ignore[no-untyped-def]
    """Number of upright regions, and of those taller than one person may be."""
    count, taller = 0, 0
    intercept, slope = line
    for k in range(boxes.shape[0]):
        if _is_upright(boxes[k], areas[k], rows, columns):
            count += 1
            taller += boxes[k, 3] > tall * max(intercept + slope * (boxes[k, 1] + boxes[k, 3]), TABLE.lowest)
    return count, taller


@njit(cache=True, nogil=True)
def _fit(pixels, rows, agree):  # type: ignore[no-untyped-def]
    """Iteratively reweighted line fit on relative residuals, from a wide Cauchy weight to a narrow one."""
    centers = TABLE.lowest * TABLE.ratio ** (np.arange(TABLE.levels) + 0.5)
    intercept, slope = 0.0, 0.0
    for iteration in range(7):
        scale = max(0.8 * 0.6**iteration, 0.1)
        n = sy = sh = syy = syh = 0.0
        for band in range(TABLE.bands):
            y = (band + 0.5) * rows / TABLE.bands
            for level in range(TABLE.levels):
                weight = pixels[band, level]
                if weight == 0.0:
                    continue
                h = centers[level]
                if iteration > 0:
                    weight /= 1.0 + ((h - intercept - slope * y) / (scale * h)) ** 2
                n += weight
                sy += weight * y
                sh += weight * h
                syy += weight * y * y
                syh += weight * y * h
        intercept, slope = height_line(n, sy, sh, syy, syh, rows, 3.0)
    total = near = taller = 0.0
    by_level, by_band = np.zeros(TABLE.levels), np.zeros(TABLE.bands)
    for band in range(TABLE.bands):
        expected = max(intercept + slope * (band + 0.5) * rows / TABLE.bands, TABLE.lowest)
        for level in range(TABLE.levels):
            total += pixels[band, level]
            by_level[level] += pixels[band, level]
            by_band[band] += pixels[band, level]
            if abs(centers[level] - expected) <= agree * expected:
                near += pixels[band, level]
            elif centers[level] > expected:
                taller += pixels[band, level]
    half, typical = 0.0, centers[0]
    for level in range(TABLE.levels):
        half += by_level[level]
        if half >= 0.5 * total:
            typical = centers[level]
            break
    # A single region far from the others is no evidence.
    first, last, below, above = 0, TABLE.bands - 1, by_band[0], by_band[TABLE.bands - 1]
    while first < last and below < 0.01 * total:
        first += 1
        below += by_band[first]
    while last > first and above < 0.01 * total:
        last -= 1
        above += by_band[last]
    # People stand a little farther than anyone was seen whole: one band more on either side.
    first_row, last_row = (first - 1) * rows / TABLE.bands, (last + 2) * rows / TABLE.bands
    return intercept, slope, near / max(near + taller, 1.0), near / total, typical, first_row, last_row
