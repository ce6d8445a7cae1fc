"""Features of many boxes at once: sums over a grid of cells, computed from one multi-channel integral image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from servotrack.estimators.color.histogram import color_bin
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import FloatArray

ORIENTATIONS = 6
"""Number of gradient directions from 0 to pi."""
CHANCE = ORIENTATIONS + 3
"""Index of the channel with the probability that a pixel belongs to the object."""
CHANNELS = ORIENTATIONS + 4
"""Channels: gradient strength by direction, lightness, two opponent colors, probability of the object."""


_TANGENTS = tuple(np.float32(np.tan(np.radians(border))) for border in (15.0, 45.0, 75.0))
"""Tangents of the angles between neighboring directions, up to the upright one."""


@njit(cache=True, nogil=True)
def direction(dx, dy):  # type: ignore[no-untyped-def]
    """Index of the nearest of the `ORIENTATIONS`, regardless of sign: 0 along the rows, 3 along the columns."""
    if dy < 0.0:
        dx, dy = -dx, -dy
    across = abs(dx)
    steps = int(dy > across * _TANGENTS[0]) + int(dy > across * _TANGENTS[1]) + int(dy > across * _TANGENTS[2])
    return ORIENTATIONS - steps if dx < 0.0 and 0 < steps < 3 else steps


@njit(cache=True, nogil=True)
def integrate_channels(region, chances, bins, integral):  # type: ignore[no-untyped-def]
    """Integral image of all channels.

    Args:
        region: RGB, shape (h, w, 3), uint8.
        chances: Probability of each color bin to belong to the object, shape (bins ** 3,), float32.
        bins: Number of bins of each color channel.
        integral: Output, shape (h + 1, w + 1, CHANNELS), float32.
    """
    rows, columns = region.shape[:2]
    gray = np.empty((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            pixel = region[row, column]
            gray[row, column] = 0.3 * pixel[0] + 0.59 * pixel[1] + 0.11 * pixel[2]
    integral[0] = 0.0
    integral[:, 0] = 0.0
    so_far = np.empty(CHANNELS, np.float32)
    for row in range(rows):
        so_far[:] = 0.0
        up, down = max(row - 1, 0), min(row + 1, rows - 1)
        for column in range(columns):
            dx = gray[row, min(column + 1, columns - 1)] - gray[row, max(column - 1, 0)]
            dy = gray[down, column] - gray[up, column]
            # The root reduces the difference between contours of weak and strong contrast.
            so_far[direction(dx, dy)] += np.sqrt(np.sqrt(dx * dx + dy * dy))
            pixel = region[row, column]
            red, green, blue = np.float32(pixel[0]), np.float32(pixel[1]), np.float32(pixel[2])
            so_far[ORIENTATIONS] += gray[row, column]
            so_far[ORIENTATIONS + 1] += red - green
            so_far[ORIENTATIONS + 2] += np.float32(0.5) * (red + green) - blue
            so_far[CHANCE] += chances[color_bin(pixel, bins)]
            above, here = integral[row, column + 1], integral[row + 1, column + 1]
            for k in range(CHANNELS):
                here[k] = above[k] + so_far[k]


@njit(cache=True, nogil=True)
def turned_part(image, center, cos, sin, out):  # type: ignore[no-untyped-def]
    """Sample the surroundings of a point as if the frame had been turned about it; pixels outside repeat the border.

    Args:
        image: RGB, shape (H, W, 3), uint8.
        center: The point, shape (2,), px.
        cos: Cosine of the angle from the frame to `out`, positive from the right to down.
        sin: Sine of that angle.
        out: Output, its middle is the point; shape (h, w, 3), uint8.
    """
    rows, columns = out.shape[:2]
    for row in range(rows):
        for column in range(columns):
            u, v = column + 0.5 - 0.5 * columns, row + 0.5 - 0.5 * rows
            x = min(max(center[0] + cos * u + sin * v - 0.5, 0.0), image.shape[1] - 1.0)
            y = min(max(center[1] - sin * u + cos * v - 0.5, 0.0), image.shape[0] - 1.0)
            left, top = int(x), int(y)
            right, bottom = min(left + 1, image.shape[1] - 1), min(top + 1, image.shape[0] - 1)
            a, b = x - left, y - top
            for channel in range(3):
                upper = (1.0 - a) * image[top, left, channel] + a * image[top, right, channel]
                lower = (1.0 - a) * image[bottom, left, channel] + a * image[bottom, right, channel]
                out[row, column, channel] = np.uint8((1.0 - b) * upper + b * lower + 0.5)


@njit(cache=True, nogil=True)
def _corner(integral, x, y, first, out):  # type: ignore[no-untyped-def]
    """Interpolate the channels from `first` on bilinearly at any point; outside the region use its border."""
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    x, y = min(max(x, 0.0), float(columns)), min(max(y, 0.0), float(rows))
    left, top = min(int(x), columns - 1), min(int(y), rows - 1)
    a, b = np.float32(x - left), np.float32(y - top)
    p, q, r, s = integral[top, left], integral[top, left + 1], integral[top + 1, left], integral[top + 1, left + 1]
    one = np.float32(1.0)
    for k in range(first, CHANNELS):
        out[k] = (one - b) * ((one - a) * p[k] + a * q[k]) + b * ((one - a) * r[k] + a * s[k])


@lru_cache(maxsize=64)
def cell_weights(grid: int, corners: float) -> FloatArray:
    """Weights of the cells of a box, shape (grid * grid,): 1 inside the ellipse that fills it, `corners` outside."""
    at = (np.arange(grid) + 0.5) / (0.5 * grid) - 1.0
    weights = np.where(at[:, None] ** 2 + at**2 > 1.0, np.float32(corners), np.float32(1.0)).reshape(-1)
    weights.setflags(write=False)
    return weights


@njit(cache=True, nogil=True)
def describe(integral, boxes, grid, rim, weights, found, contrast):  # type: ignore[no-untyped-def]
    """Features of boxes.

    Args:
        integral: Integral image from `integrate_channels`.
        boxes: Left, top, width and height relative to the region's corner. Shape (n, 4), px.
        grid: Number of cells per side.
        rim: Width of the surroundings, as a share of the box, above 0.
        weights: Weight of each cell in the features, shape (grid * grid,), float32.
        found: Output, shape (n, 2, grid * grid * c), float32: gradients of all cells, then colors, centered; both of
            unit length. The last axis has the length of the longer vector; the rest is zeros.
        contrast: Output: mean probability inside the box minus that in the rim, shape (n,), float64.
    """
    corners = np.empty((3, max(grid + 1, 4), CHANNELS), np.float32)
    for n in range(boxes.shape[0]):
        contrast[n] = _describe_box(integral, boxes[n], grid, rim, weights, corners, found[n])


@njit(cache=True, nogil=True)
def compare(integral, boxes, grid, rim, weights, views, nearest, recent, loyalty, alike, contrast):  # type: ignore[no-untyped-def]
    """Cosines between the features of boxes and a reference, without a copy of the features.

    Args:
        integral: Integral image from `integrate_channels`.
        boxes: Left, top, width and height relative to the region's corner. Shape (n, 4), px.
        grid: Number of cells per side.
        rim: Width of the surroundings, as a share of the box, above 0.
        weights: Weight of each cell in the features, shape (grid * grid,), float32.
        views: Features of the views of the first box, shape (angles, 2, f), float32.
        nearest: Index of the view with which each box is compared, shape (n,), int64.
        recent: Features of recent frames, shape (2, f), float32.
        loyalty: Share of the view in the result, float32; the recent features have the rest.
        alike: Output: cosines of gradients and of colors, shape (n, 2), float64.
        contrast: Output: mean probability inside the box minus that in the rim, shape (n,), float64.
    """
    corners = np.empty((3, max(grid + 1, 4), CHANNELS), np.float32)
    found = np.zeros(recent.shape, np.float32)
    for n in range(boxes.shape[0]):
        contrast[n] = _describe_box(integral, boxes[n], grid, rim, weights, corners, found)
        for part in range(2):
            alike[n, part] = loyalty * _dot(views[nearest[n], part], found[part])
            if loyalty < 1.0:
                alike[n, part] += (np.float32(1.0) - loyalty) * _dot(recent[part], found[part])


@njit(cache=True, nogil=True)
def _describe_box(integral, box, grid, rim, weights, corners, found):  # type: ignore[no-untyped-def]
    """Write the features of one box into `found` and return its contrast; `corners` is scratch space."""
    left, top, width, height = box
    first, second, around = corners[0], corners[1], corners[2]
    gradients, colors = found[0], found[1]
    cells = grid * grid
    for column in range(grid + 1):
        _corner(integral, left + width * column / grid, top, 0, first[column])
    inside = np.float32(0.0)
    for row in range(grid):
        for column in range(grid + 1):
            _corner(integral, left + width * column / grid, top + height * (row + 1) / grid, 0, second[column])
        for column in range(grid):
            at = row * grid + column
            a, b, c, d = first[column], first[column + 1], second[column], second[column + 1]
            for k in range(ORIENTATIONS):
                gradients[at * ORIENTATIONS + k] = weights[at] * (d[k] - c[k] - b[k] + a[k])
            for k in range(CHANCE - ORIENTATIONS):
                channel = ORIENTATIONS + k
                colors[k * cells + at] = d[channel] - c[channel] - b[channel] + a[channel]
            inside += d[CHANCE] - c[CHANCE] - b[CHANCE] + a[CHANCE]
        first, second = second, first
    for k in range(4):
        across, along = k % 2, k // 2
        _corner(
            integral,
            left - rim * width + (1.0 + 2.0 * rim) * width * across,
            top - rim * height + (1.0 + 2.0 * rim) * height * along,
            CHANCE,
            around[k],
        )
    total = weights.sum()
    for channel in range(CHANCE - ORIENTATIONS):
        part = colors[channel * cells : (channel + 1) * cells]
        mean = _dot(weights, part) / total
        for at in range(cells):
            part[at] = weights[at] * (part[at] - mean)
    _unit(gradients)
    _unit(colors)
    outside = around[3, CHANCE] - around[2, CHANCE] - around[1, CHANCE] + around[0, CHANCE] - inside
    area = width * height
    return inside / area - outside / (area * ((1.0 + 2.0 * rim) ** 2 - 1.0))


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    """Inner product in four partial sums, which a processor computes at once."""
    p, q, r, s = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    whole = a.shape[0] // 4 * 4
    for k in range(0, whole, 4):
        p += a[k] * b[k]
        q += a[k + 1] * b[k + 1]
        r += a[k + 2] * b[k + 2]
        s += a[k + 3] * b[k + 3]
    for k in range(whole, a.shape[0]):
        p += a[k] * b[k]
    return (p + q) + (r + s)


@njit(cache=True, nogil=True)
def _unit(values):  # type: ignore[no-untyped-def]
    total = _dot(values, values)
    if total > 0.0:
        factor = np.float32(1.0) / np.sqrt(total)
        for k in range(values.shape[0]):
            values[k] *= factor
