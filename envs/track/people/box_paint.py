"""Painting of boxes, points, trails and tags into video frames of any size, fast enough for live video."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servotrack.envs.drawing.glyphs import put_text, text_width
from servotrack.envs.drawing.palette import INK, IVORY, Color, mix
from servotrack.envs.drawing.plots import TRAIL_LENGTH, identity_color
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Image

_HELD_OPACITY = 0.38
_CORNER = 0.28  # share of a side that a bracket at its end takes
_TRUTH_COLOR: Color = (255, 250, 235)
_DETECTION_COLOR: Color = (255, 214, 92)


class BoxTrail(NamedTuple):
    """Past states of one identity, oldest first, current estimate last.

    Attributes:
        label: Identity; it decides the color and is written on the tag.
        states: Boxes (left, top, width, height), shape (k, 4), or points, shape (k, 2); px.
    """

    label: int
    states: Array


@njit(cache=True, nogil=True)
def _blend(image, i, j, color, share):  # type: ignore[no-untyped-def]
    for c in range(3):
        value = image[i, j, c]
        image[i, j, c] = np.uint8(value + (color[c] - value) * share + 0.5)


@njit(cache=True, nogil=True)
def _paint_box(image, box, color, thickness, radius, opacity, fill, brackets):  # type: ignore[no-untyped-def]
    """Paint a rounded outline with a dark rim. With `brackets` > 0 only this share of a side is drawn at both ends."""
    left, top, width, height = box[0], box[1], box[2], box[3]
    half_width, half_height = 0.5 * width, 0.5 * height
    x0, y0 = left + half_width, top + half_height
    radius = min(radius, min(half_width, half_height))
    dark = (24.0, 28.0, 34.0)
    reach = thickness + 2.0
    hole_x, hole_y = half_width - radius - reach, half_height - radius - reach
    for i in range(max(int(top - reach), 0), min(int(top + height + reach) + 1, image.shape[0])):
        y = abs(i + 0.5 - y0)
        for j in range(max(int(left - reach), 0), min(int(left + width + reach) + 1, image.shape[1])):
            x = abs(j + 0.5 - x0)
            if x < hole_x and y < hole_y:
                if fill > 0.0:
                    _blend(image, i, j, color, fill * opacity)
                continue
            if brackets > 0.0 and x < half_width * (1.0 - 2.0 * brackets):
                continue
            if brackets > 0.0 and y < half_height * (1.0 - 2.0 * brackets):
                continue
            dx, dy = max(x - half_width + radius, 0.0), max(y - half_height + radius, 0.0)
            inside = min(max(x - half_width + radius, y - half_height + radius), 0.0)
            distance = math.sqrt(dx * dx + dy * dy) + inside - radius
            # The line lies inside the box, its rim just outside and inside of it.
            line = min(max(0.5 * thickness + 0.5 - abs(distance + 0.5 * thickness), 0.0), 1.0)
            rim = min(max(0.5 * thickness + 1.5 - abs(distance + 0.5 * thickness), 0.0), 1.0)
            if fill > 0.0 and distance < 0.0:
                _blend(image, i, j, color, fill * opacity)
            if rim > 0.0:
                _blend(image, i, j, dark, 0.35 * opacity * rim)
            if line > 0.0:
                _blend(image, i, j, color, opacity * line)


@njit(cache=True, nogil=True)
def _paint_trail(image, points, color, thickness, oldest, newest):  # type: ignore[no-untyped-def]
    """Paint a line through points whose opacity changes from `oldest` to `newest`."""
    segments = len(points) - 1
    reach = 0.5 * thickness + 0.5
    for k in range(segments):
        ax, ay, bx, by = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        length2 = (bx - ax) ** 2 + (by - ay) ** 2
        if length2 < 1e-9 or length2 > 1e8:
            continue
        opacity = oldest + (newest - oldest) * (k + 1) / segments
        first, last = max(int(min(ay, by) - reach), 0), min(int(max(ay, by) + reach) + 1, image.shape[0])
        for i in range(first, last):
            py = i + 0.5 - ay
            start, stop = max(int(min(ax, bx) - reach), 0), min(int(max(ax, bx) + reach) + 1, image.shape[1])
            for j in range(start, stop):
                px = j + 0.5 - ax
                t = (px * (bx - ax) + py * (by - ay)) / length2
                # Half-open segments: neighbors must not paint their common point twice.
                if t <= 0.0 or t > 1.0:
                    continue
                distance = abs(px * (by - ay) - py * (bx - ax)) / math.sqrt(length2)
                cover = min(reach - distance, 1.0)
                if cover > 0.0:
                    _blend(image, i, j, color, opacity * cover)


@njit(cache=True, nogil=True)
def _paint_disc(image, x, y, radius, color, opacity):  # type: ignore[no-untyped-def]
    """Paint a disc with an ivory rim."""
    rim = (253.0, 252.0, 249.0)
    reach = radius + 2.0
    for i in range(max(int(y - reach), 0), min(int(y + reach) + 1, image.shape[0])):
        for j in range(max(int(x - reach), 0), min(int(x + reach) + 1, image.shape[1])):
            distance = math.hypot(j + 0.5 - x, i + 0.5 - y)
            outer = min(max(radius + 1.7 - distance, 0.0), 1.0)
            inner = min(max(radius + 0.5 - distance, 0.0), 1.0)
            if outer > 0.0:
                _blend(image, i, j, rim, opacity * outer)
            if inner > 0.0:
                _blend(image, i, j, color, opacity * inner)


def line_width(height: int) -> float:
    """Return the line width of boxes in a frame of this height, px."""
    return max(1.4, height / 288.0)


def annotate(
    image: Image,
    reported: Sequence[BoxTrail],
    held: Sequence[BoxTrail] = (),
    truth: Array | None = None,
    detections: Array | None = None,
    caption: str | None = None,
) -> None:
    """Paint the output of a tracker into a frame, in place.

    Args:
        image: Contiguous RGB image, shape (H, W, 3), uint8.
        reported: Trails of reported identities.
        held: Trails of identities that are held without being reported; they are fainter and have no tag.
        truth: True boxes, shape (n, 4), or points, shape (n, 2), px.
        detections: Detected boxes, shape (n, 4), or points, shape (n, 2), px.
        caption: Text at the top left, e.g. the number of people. Characters that the font lacks are left out.
    """
    width = line_width(image.shape[0])
    if detections is not None:
        _outlines(image, detections, _DETECTION_COLOR, max(0.6 * width, 1.0), 0.6, 0.0)
    if truth is not None:
        _outlines(image, truth, _TRUTH_COLOR, max(0.6 * width, 1.0), 0.95, _CORNER)
    for trail in (*held, *reported):
        _trail(image, trail, width)
    for trail in held:
        _state(image, trail, width, _HELD_OPACITY)
    for trail in reported:
        _state(image, trail, width, 1.0)
    for trail in reported:
        _tag(image, trail, width)
    if caption:
        _caption(image, caption, width)


def printable(text: str) -> str:
    """Return the text in lower case, with characters that the font lacks replaced by spaces."""
    plain = text.lower().replace("_", "-")
    return " ".join("".join(c if _known(c) else " " for c in plain).split())


def _known(character: str) -> bool:
    try:
        text_width(character, 7.0)
    except ValueError:
        return False
    return True


def _anchor(states: Array) -> Array:
    """Return the points of a trail: the bottom centers of boxes, or the points themselves."""
    if states.shape[1] == 2:
        return states
    return states[:, :2] + states[:, 2:] * np.array([0.5, 1.0])


def _outlines(image: Image, states: Array, color: Color, thickness: float, opacity: float, brackets: float) -> None:
    for state in np.asarray(states, dtype=np.float64):
        if len(state) == 4 and min(state[2], state[3]) <= 0.0:
            continue
        if len(state) == 2:
            _paint_disc(image, state[0], state[1], thickness, color, opacity)
        else:
            _paint_box(image, _inside(state), color, thickness, 1.0, opacity, 0.0, brackets)


def _trail(image: Image, trail: BoxTrail, width: float) -> None:
    points = _anchor(np.asarray(trail.states[-TRAIL_LENGTH:], dtype=np.float64))
    if len(points) > 1 and np.isfinite(points).all():
        _paint_trail(image, np.ascontiguousarray(points), identity_color(trail.label), 1.5 * width, 0.1, 0.9)


def _state(image: Image, trail: BoxTrail, width: float, opacity: float) -> None:
    state = np.asarray(trail.states[-1], dtype=np.float64)
    color = identity_color(trail.label)
    if len(state) == 2:
        _paint_disc(image, state[0], state[1], 2.4 * width, color, opacity)
    else:
        _paint_box(image, _inside(state), color, width, 2.5 * width, opacity, 0.10, 0.0)


def _inside(box: Array) -> Array:
    """Return a box of at least one pixel, clipped far outside any image, which bounds the loops over its pixels."""
    left, top = np.clip(np.nan_to_num(box[:2]), -1e5, 1e5)
    return np.array([left, top, *np.clip(np.nan_to_num(box[2:]), 1.0, 1e5)])


def _tag(image: Image, trail: BoxTrail, width: float) -> None:
    """Paint the label on the color of its identity, above the box or, at the top of the image, inside it."""
    state = np.nan_to_num(np.asarray(trail.states[-1], dtype=np.float64))
    text = str(trail.label)
    size = 6.0 + 2.2 * (width - 1.0)
    wide, tall = text_width(text, size) + 1.3 * size, 1.75 * size
    if len(state) == 2:
        left, top = state[0] + 3.0 * width, state[1] - tall - 2.0 * width
    else:
        left, top = state[0], state[1] - tall + width
    left = min(max(left, 0.0), max(image.shape[1] - wide, 0.0))
    top = min(max(top, 0.0), max(image.shape[0] - tall, 0.0))
    color = identity_color(trail.label)
    _paint_box(image, np.array([left, top, wide, tall]), color, 0.5 * tall, 1.5 * width, 0.95, 0.95, 0.0)
    put_text(image, text, left + 0.5 * wide, top + 0.5 * (tall + size), IVORY, size, max(1.0, 0.15 * size), "center")


def _caption(image: Image, caption: str, width: float) -> None:
    text = printable(caption)
    size = 7.0 * width**0.8
    wide, tall = text_width(text, size) + 2.2 * size, 2.4 * size
    place = np.array([0.9 * size, 0.9 * size, wide, tall])
    _paint_box(image, place, mix(INK, IVORY, 0.02), 0.5 * tall, 0.7 * size, 0.72, 0.9, 0.0)
    put_text(image, text, 2.0 * size, 0.9 * size + 0.5 * (tall + size), IVORY, size, max(1.0, 0.15 * size))
