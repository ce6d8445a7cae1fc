"""Rasterizer of tubes of variable width, from which people, plants and pillars are made.

A part is a row of `NUMBERS` numbers; the constants name the columns. Parts are drawn into a small premultiplied RGBA
patch, and patches are blended into the picture in depth order.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

START, END = 0, 2
"""Image column and row of the two ends of the axis, px."""
WIDTHS = 4
"""Half widths at `SAMPLES` equally spaced points of the axis, px."""
SAMPLES = 6
CAPS = 10
"""Lengths of the two end caps beyond the axis, half widths."""
COLOR, SECOND = 12, 15
MATERIAL, RELIEF, BRIGHTNESS = 18, 19, 20
"""Material of the surface, strength of the shading of its roundness, and factor on its brightness."""
FORWARD = 21
"""Heading of the body in camera axes: right, down, toward the camera."""
TILT = 24
"""Sine of the angle by which the camera looks down at the part."""
DEPTH = 25
"""Closeness to the camera; closer parts are drawn later."""
GRAIN, ORIGIN, DETAIL = 26, 27, 28
"""Amplitude of the folds of cloth, offset in the grain tile, and detail of the material."""
NUMBERS = 29

PLAIN, HEAD, OPEN, STRIPES, CHECK = range(5)
"""Materials: one color; head with hair and face; open jacket over a shirt; stripes; checks."""

GRAIN_SIDE = 64
"""Number of rows and columns of the grain tile, a power of two."""

_HALF, _ONE, _OPAQUE = np.float32(0.5), np.float32(1.0), np.float32(0.9995)
_LIGHT = (-0.42, -0.62, 0.66)  # direction toward the light in camera axes: left, up, toward the camera
_MEAN_LIGHT = 0.56  # mean brightness of a tube in that light


def fold_cloth(rng: np.random.Generator) -> Array:
    """Return the grain tile: soft folds in [-1, 1], shape (GRAIN_SIDE, GRAIN_SIDE)."""
    margin = 8
    rough = np.pad(rng.standard_normal((GRAIN_SIDE, GRAIN_SIDE)), margin, mode="wrap")
    soft = cv2.GaussianBlur(rough, (0, 0), 1.6)[margin:-margin, margin:-margin]
    return np.ascontiguousarray(soft / np.abs(soft).max())


@njit(cache=True, nogil=True)
def extent(parts, count):  # type: ignore[no-untyped-def]
    """Return left, top, right and bottom of the first `count` parts, whole px."""
    left, top, right, bottom = 1e9, 1e9, -1e9, -1e9
    for k in range(count):
        reach = 0.0
        for i in range(SAMPLES):
            reach = max(reach, parts[k, WIDTHS + i])
        reach = reach * max(1.0, max(parts[k, CAPS], parts[k, CAPS + 1])) + 1.0
        left = min(left, min(parts[k, 0], parts[k, 2]) - reach)
        right = max(right, max(parts[k, 0], parts[k, 2]) + reach)
        top = min(top, min(parts[k, 1], parts[k, 3]) - reach)
        bottom = max(bottom, max(parts[k, 1], parts[k, 3]) + reach)
    return math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom)


@njit(cache=True, nogil=True)
def _smooth(x):  # type: ignore[no-untyped-def]
    """Smoothstep: 0 below 0, 1 above 1, smooth between."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@njit(cache=True, nogil=True)
def _second_share(part, t, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Return the share of the second color at a surface point, from its position and normal."""
    material = int(part[MATERIAL])
    detail = part[DETAIL]
    if material == HEAD:
        # The face is where the normal points forward more than up; `detail` moves the hairline.
        forward = nx * part[FORWARD] + ny * part[FORWARD + 1] + nz * part[FORWARD + 2]
        up = -ny * math.sqrt(1.0 - part[TILT] * part[TILT]) + nz * part[TILT]
        return _smooth((forward - 0.75 * up - detail) * 5.0 + 0.5)
    if material == OPEN:
        forward = nx * part[FORWARD] + nz * part[FORWARD + 2]
        lateral = nx * part[FORWARD + 2] - nz * part[FORWARD]
        half = detail * (1.25 - 0.8 * t)
        return _smooth((half - abs(lateral)) * 9.0 + 0.5) if forward > 0.0 else 0.0
    if material == STRIPES:
        return _smooth(2.2 * math.sin(detail * t * 6.2831853) + 0.3)
    if material == CHECK:
        across = nx * 4.0
        return 0.5 * _smooth(1.5 * math.sin(detail * t * 6.2831853) + 0.5) + 0.5 * _smooth(
            1.5 * math.sin(across * 3.0) + 0.5
        )
    return 0.0


@njit(cache=True, nogil=True)
def _span(offset, slope, low, high, first, last):  # type: ignore[no-untyped-def]
    """Return the part of [first, last) in which offset + slope * column lies between low and high."""
    if abs(slope) < 1e-4:
        return (first, last) if low <= offset <= high else (first, first)
    a, b = (low - offset) / slope, (high - offset) / slope
    if a > b:
        a, b = b, a
    return max(first, math.floor(max(a, -1e6))), min(last, math.ceil(min(b, 1e6)) + 1)


@njit(cache=True, nogil=True, fastmath=True)
def draw_parts(parts, order, count, left, top, grain, patch):  # type: ignore[no-untyped-def]
    """Draw parts into a zero patch whose corner is pixel (left, top). The last part of `order` is in front.

    Front parts are drawn first, so that covered pixels are shaded only once.
    """
    rows, columns = patch.shape[0], patch.shape[1]
    last = GRAIN_SIDE - 1
    for index in range(count):
        part = parts[order[count - 1 - index]]
        x0, y0 = part[0], part[1]
        length = math.hypot(part[2] - x0, part[3] - y0)
        inverse = 1.0 / max(length, 1e-6)
        ex, ey = (part[2] - x0) * inverse, (part[3] - y0) * inverse
        if length < 1e-6:
            ex, ey = 0.0, 1.0
        reach = 0.0
        for i in range(SAMPLES):
            reach = max(reach, part[WIDTHS + i])
        reach += 0.5
        head, tail = 1.0 / max(part[CAPS], 1e-3), 1.0 / max(part[CAPS + 1], 1e-3)
        before, after = -reach / head - 0.5, length + reach / tail + 0.5
        farthest = max(reach, max(-before, after - length)) + 1.0
        first_row = max(math.floor(min(y0, part[3]) - farthest) - top, 0)
        last_row = min(math.ceil(max(y0, part[3]) + farthest) - top, rows)
        relief, bright, folds = part[RELIEF], part[BRIGHTNESS], part[GRAIN]
        red, green, blue = part[COLOR], part[COLOR + 1], part[COLOR + 2]
        more_red, more_green, more_blue = part[SECOND] - red, part[SECOND + 1] - green, part[SECOND + 2] - blue
        plain = part[MATERIAL] == PLAIN
        origin = int(part[ORIGIN])
        knots = inverse * (SAMPLES - 1)
        for i in range(first_row, last_row):
            py = top + i + 0.5 - y0
            corner = left + 0.5 - x0
            first_column, last_column = _span(py * ex - corner * ey, -ey, -reach, reach, 0, columns)
            first_column, last_column = _span(py * ey + corner * ex, ex, before, after, first_column, last_column)
            for j in range(first_column, last_column):
                free = 1.0 - patch[i, j, 3]
                if free < 1e-3:
                    continue
                px = corner + j
                along = px * ex + py * ey
                across = py * ex - px * ey
                beyond, place, steep = 0.0, along * knots, 1.0
                if along < 0.0:
                    beyond, place, steep = along * head, 0.0, head
                elif along > length:
                    beyond, place, steep = (along - length) * tail, SAMPLES - 1.0, tail
                knot = min(int(place), SAMPLES - 2)
                width = part[WIDTHS + knot] + (part[WIDTHS + knot + 1] - part[WIDTHS + knot]) * (place - knot)
                distance2 = across * across + beyond * beyond
                # A flat cap is a squeezed half disc: the distance to its edge is that of the disc over the gradient.
                edge = 0.5
                if beyond != 0.0:
                    along_edge = beyond * steep
                    edge = 0.5 * math.sqrt((across * across + along_edge * along_edge) / distance2)
                outer = width + edge
                if distance2 >= outer * outer:
                    continue
                inner = width - edge
                cover = 1.0
                if inner <= 0.0 or distance2 > inner * inner:
                    cover = min((outer - math.sqrt(distance2)) / (2.0 * edge), 1.0)
                scale = 1.0 / max(width, 0.5)
                na, nb = across * scale, beyond * scale
                nx, ny = nb * ex - na * ey, nb * ey + na * ex
                nz = math.sqrt(max(1.0 - na * na - nb * nb, 0.0))
                light = nx * _LIGHT[0] + ny * _LIGHT[1] + nz * _LIGHT[2] - _MEAN_LIGHT
                shade = bright * (1.0 + relief * light)
                if folds > 0.0:
                    row = int((along + 64.0) * 0.7) + origin
                    column = int(across * 1.1 + 64.0) + 3 * origin
                    shade *= 1.0 + folds * grain[row & last, column & last]
                share = 0.0 if plain else _second_share(part, place / (SAMPLES - 1), nx, ny, nz)
                cover *= free
                patch[i, j, 0] += cover * min((red + more_red * share) * shade, 255.0)
                patch[i, j, 1] += cover * min((green + more_green * share) * shade, 255.0)
                patch[i, j, 2] += cover * min((blue + more_blue * share) * shade, 255.0)
                patch[i, j, 3] += cover


@njit(cache=True, nogil=True)
def measure_silhouette(patch, left, top, width, height, box):  # type: ignore[no-untyped-def]
    """Write the bounding box of a silhouette inside the image to `box`. Return its total number of pixels."""
    first_row, last_row, first_column, last_column = 1 << 30, -1, 1 << 30, -1
    total = 0
    for i in range(patch.shape[0]):
        inside_row = 0 <= top + i < height
        for j in range(patch.shape[1]):
            if patch[i, j, 3] >= 0.5:
                total += 1
                if inside_row and 0 <= left + j < width:
                    first_row, last_row = min(first_row, i), max(last_row, i)
                    first_column, last_column = min(first_column, j), max(last_column, j)
    if last_row >= 0:
        box[0] = left + first_column
        box[1] = top + first_row
        box[2] = last_column - first_column + 1
        box[3] = last_row - first_row + 1
    return total


@njit(cache=True, nogil=True)
def lay_over(patch, left, top, owner, image, owners, visible):  # type: ignore[no-untyped-def]
    """Blend a patch into the picture and set `owners` in its silhouette to `owner`; 0 for objects."""
    height, width = owners.shape
    for i in range(max(0, -top), min(patch.shape[0], height - top)):
        for j in range(max(0, -left), min(patch.shape[1], width - left)):
            cover = patch[i, j, 3]
            if cover <= 0.0:
                continue
            y, x = top + i, left + j
            if cover >= _OPAQUE:
                for c in range(3):
                    image[y, x, c] = np.uint8(patch[i, j, c] + _HALF)
            else:
                keep = _ONE - cover
                for c in range(3):
                    image[y, x, c] = np.uint8(image[y, x, c] * keep + patch[i, j, c] + _HALF)
            if cover >= 0.5:
                before = owners[y, x]
                if before > 0:
                    visible[before - 1] -= 1
                if owner > 0:
                    visible[owner - 1] += 1
                owners[y, x] = owner


@njit(cache=True, nogil=True)
def patch_at(pool, start, extents):  # type: ignore[no-untyped-def]
    """Return a view of the patch with extents (left, top, right, bottom) that begins at `start` in the pool."""
    rows, columns = extents[3] - extents[1], extents[2] - extents[0]
    return pool[start : start + 4 * rows * columns].reshape((rows, columns, 4))
