"""Painting of counting zones and lines into video frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from servotrack.envs.drawing.glyphs import put_text, text_width
from servotrack.envs.drawing.palette import INK, IVORY, TEAL, VERMILION, Color, fixed_point
from servotrack.envs.drawing.plots import SUBPIXEL_BITS
from servotrack.envs.track.people.box_paint import line_width, printable
from servotrack.estimators.types import Array, Image

_FILL = 0.16
"""Opacity of a zone."""


class PlaceMark(NamedTuple):
    """A zone or a line in a picture.

    Attributes:
        points: Corners of a zone, or the ends of a line, px.
        zone: True for a zone. A line gets an arrow in its forward direction.
        text: Name and count. Characters that the font lacks are left out.
    """

    points: tuple[tuple[float, float], ...]
    zone: bool
    text: str


def paint_places(image: Image, marks: Sequence[PlaceMark], scale: float) -> None:
    """Paint zones and lines, in place.

    Args:
        image: Contiguous RGB image, shape (H, W, 3), uint8.
        marks: Zones and lines.
        scale: Pixels of the image for each of the marks.
    """
    width = line_width(image.shape[0])
    for mark in marks:
        points = np.asarray(mark.points, dtype=np.float64) * scale
        if mark.zone:
            mask = np.zeros(image.shape[:2], np.uint8)
            cv2.fillPoly(mask, [fixed_point(points)], 255, cv2.LINE_AA, SUBPIXEL_BITS)
            inside = mask > 0
            image[inside] = (image[inside] * (1.0 - _FILL) + np.array(TEAL) * _FILL).astype(np.uint8)
        _stroke(image, points, mark.zone, TEAL if mark.zone else VERMILION, width)
        if not mark.zone:
            _stroke(image, _arrow(points, 6.0 * width), False, VERMILION, width)


def write_places(image: Image, marks: Sequence[PlaceMark], scale: float) -> None:
    """Write the counts of zones and lines, in place; arguments as those of `paint_places`."""
    width = line_width(image.shape[0])
    size = 6.0 + 2.2 * (width - 1.0)
    for mark in marks:
        text = printable(mark.text)
        points = np.asarray(mark.points, dtype=np.float64) * scale
        place = points[points[:, 1].argmin()] if mark.zone else points[0]
        wide, tall = text_width(text, size) + 1.3 * size, 2.0 * size
        left = round(min(max(place[0] + 2.0 * width, 0.0), max(image.shape[1] - wide, 0.0)))
        top = round(min(max(place[1] + 2.0 * width, 0.0), max(image.shape[0] - tall, 0.0)))
        cv2.rectangle(image, (left, top), (left + round(wide), top + round(tall)), INK, -1)
        middle = top + 0.5 * (tall + size)
        put_text(image, text, left + 0.65 * size, middle, IVORY, size, max(1.0, 0.15 * size))


def _stroke(image: Image, points: Array, closed: bool, color: Color, width: float) -> None:
    shape = [fixed_point(points)]
    for tint, thickness in ((IVORY, round(1.2 * width) + 2), (color, max(round(1.2 * width), 1))):
        cv2.polylines(image, shape, closed, tint, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _arrow(points: Array, length: float) -> Array:
    """Points of an arrow from the middle of a line to its right side in the image, where rows grow downward."""
    along = (points[1] - points[0]) / max(float(np.hypot(*(points[1] - points[0]))), 1e-9)
    across = np.array([-along[1], along[0]])
    middle = points.mean(axis=0)
    tip = middle + length * across
    back = tip - 0.5 * length * across
    return np.array([middle, tip, back + 0.5 * length * along, tip, back - 0.5 * length * along])
