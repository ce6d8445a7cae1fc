"""A small stroke font. OpenCV's own text differs between its major versions and is slow.

A glyph is a list of strokes, in font units: digits are 7 units high, lower-case letters 5, the baseline is at 0.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from servotrack.envs.drawing.palette import Color
from servotrack.estimators.types import FloatArray, Image

Stroke = list[tuple[float, float]]

_DIGIT_HEIGHT = 7.0
_SUPERSAMPLING = 8
_GAP = 1.9  # between two glyphs, font units
_SPACE = 2.2
_DESCENT, _ASCENT = 3.2, 8.6


def _arc(x: float, y: float, rx: float, ry: float, start: float, end: float) -> Stroke:
    """Points of an elliptic arc about (x, y), angles in degrees counterclockwise from the x axis."""
    angles = np.radians(np.linspace(start, end, 25))
    return [(x + rx * float(np.cos(a)), y + ry * float(np.sin(a))) for a in angles]


def _round(x: float, y: float, rx: float, ry: float) -> Stroke:
    return _arc(x, y, rx, ry, 0, 360)


_BOWL = _round(2.1, 2.5, 2.1, 2.5)
_NARROW_ARCH = _arc(1.6, 3.4, 1.6, 1.6, 180, 0)
_ARCH = _arc(1.9, 3.1, 1.9, 1.9, 180, 0)

_GLYPHS: dict[str, list[Stroke]] = {
    "0": [_round(2, 3.5, 2, 3.5)],
    "1": [[(0.5, 5.6), (2.1, 7), (2.1, 0)]],
    "2": [[*_arc(2, 5, 2, 2, 165, -35), (0, 0), (4, 0)]],
    "3": [[*_arc(1.9, 5.25, 1.75, 1.75, 150, -90), *_arc(1.9, 1.75, 2, 1.75, 90, -150)]],
    "4": [[(3, 0), (3, 7), (0, 2), (4.1, 2)]],
    "5": [[(3.6, 7), (0.7, 7), *_arc(1.9, 2.3, 2.1, 2.3, 132, -150)]],
    "6": [[(2.8, 7), (0.3, 3.2)], _round(2, 2.1, 2, 2.1)],
    "7": [[(0, 7), (4, 7), (1.4, 0)]],
    "8": [_round(2, 5.25, 1.7, 1.75), _round(2, 1.75, 2, 1.75)],
    "9": [[(3.7, 3.8), (1.2, 0)], _round(2, 4.9, 2, 2.1)],
    ".": [[(0.2, 0.1), (0.2, 0.1)]],
    ":": [[(0.2, 0.8), (0.2, 0.8)], [(0.2, 4.2), (0.2, 4.2)]],
    "-": [[(0, 2.6), (2.6, 2.6)]],
    "+": [[(0, 2.8), (3.4, 2.8)], [(1.7, 1.1), (1.7, 4.5)]],
    "/": [[(0, -0.6), (2.8, 7.4)]],
    "%": [_round(1.1, 5.8, 1.1, 1.2), _round(4.7, 1.2, 1.1, 1.2), [(4.6, 7), (1.2, 0)]],
    "a": [_BOWL, [(4.2, 5), (4.2, 0)]],
    "b": [[(0, 7.4), (0, 0)], _BOWL],
    "c": [_arc(2.3, 2.5, 2.3, 2.5, 48, 312)],
    "d": [_BOWL, [(4.2, 7.4), (4.2, 0)]],
    "e": [[(0.1, 2.6), *_arc(2.2, 2.5, 2.2, 2.5, 2, 310)]],
    "f": [[*_arc(2.3, 5.9, 1.3, 1.5, 65, 180), (1, 0)], [(0, 5), (2.4, 5)]],
    "g": [_BOWL, [(4.2, 5), *_arc(2.2, -0.5, 2, 1.8, 0, -145)]],
    "h": [[(0, 7.4), (0, 0)], [*_ARCH, (3.8, 0)]],
    "i": [[(0, 5), (0, 0)], [(0, 7), (0, 7)]],
    "j": [[(1.2, 5), *_arc(0, -0.6, 1.2, 1.6, 0, -90)], [(1.2, 7), (1.2, 7)]],
    "k": [[(0, 7.4), (0, 0)], [(3.3, 5), (0, 2)], [(1.3, 3.2), (3.5, 0)]],
    "l": [[(0, 7.4), (0, 0)]],
    "m": [[(0, 5), (0, 0)], [*_NARROW_ARCH, (3.2, 0)], [(x + 3.2, y) for x, y in [*_NARROW_ARCH, (3.2, 0)]]],
    "n": [[(0, 5), (0, 0)], [*_ARCH, (3.8, 0)]],
    "o": [_round(2.3, 2.5, 2.3, 2.5)],
    "p": [[(0, 5), (0, -2.2)], _BOWL],
    "q": [_BOWL, [(4.2, 5), (4.2, -2.2)]],
    "r": [[(0, 5), (0, 0)], _arc(1.8, 3.2, 1.8, 1.8, 180, 60)],
    "s": [[*_arc(1.7, 3.75, 1.5, 1.25, 40, 270), *_arc(1.7, 1.25, 1.7, 1.25, 90, -140)]],
    "t": [[(1.1, 6.8), *_arc(2.3, 1.2, 1.2, 1.2, 180, 285)], [(0, 5), (2.4, 5)]],
    "u": [[(0, 5), *_arc(1.9, 1.9, 1.9, 1.9, 180, 360), (3.8, 5)], [(3.8, 2), (3.8, 0)]],
    "v": [[(0, 5), (2, 0), (4, 5)]],
    "w": [[(0, 5), (1.5, 0), (3, 5), (4.5, 0), (6, 5)]],
    "x": [[(0, 5), (3.6, 0)], [(3.6, 5), (0, 0)]],
    "y": [[(0, 5), (2, 0.2)], [(4, 5), (1.1, -2.2)]],
    "z": [[(0, 5), (3.6, 5), (0, 0), (3.6, 0)]],
}


@lru_cache(maxsize=1024)
def _mask(text: str, height: float, weight: float) -> FloatArray:
    """Opacity of a line of text in [0, 1], shape (rows, columns, 1), with the baseline at `_ASCENT` below its top."""
    scale = height / _DIGIT_HEIGHT
    fine = scale * _SUPERSAMPLING
    rows = int(np.ceil((_ASCENT + _DESCENT) * scale))
    columns = int(np.ceil(text_width(text, height) + 2 * scale))
    canvas = np.zeros((rows * _SUPERSAMPLING, columns * _SUPERSAMPLING), dtype=np.uint8)
    thickness = max(1, round(weight * _SUPERSAMPLING))
    x = 1.0
    for character in text:
        for stroke in _GLYPHS.get(character, []):
            points = np.array([((x + px) * fine, (_ASCENT - py) * fine) for px, py in stroke])
            cv2.polylines(canvas, [np.round(points).astype(np.int32)], False, 255, thickness)
        x += _advance(character)
    small = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)
    return (small.astype(np.float32) / 255.0)[..., None]


@lru_cache(maxsize=128)
def _advance(character: str) -> float:
    strokes = _GLYPHS.get(character)
    if character == " ":
        return _SPACE + _GAP
    if strokes is None:
        raise ValueError(f"text may contain only {''.join(sorted(_GLYPHS))} and spaces, got {character!r}")
    return max(x for stroke in strokes for x, _ in stroke) + _GAP


@lru_cache(maxsize=1024)
def text_width(text: str, height: float) -> float:
    """Width of a line of text whose digits are `height` px high, px."""
    return (sum(_advance(c) for c in text) - (_GAP if text else 0.0)) * height / _DIGIT_HEIGHT


def put_text(
    image: Image,
    text: str,
    x: float,
    baseline: float,
    color: Color,
    height: float = 8.0,
    weight: float = 1.1,
    align: str = "left",
) -> None:
    """Write a line of text into an image.

    Args:
        image: Image to write into, shape (H, W, 3). Text outside of it is cut off.
        text: Digits, lower-case letters, spaces and `. : - + / %`.
        x: Column of the text's left end, right end or center, see `align`, px.
        baseline: Row of the baseline, px.
        color: Color of the text, in the image's channel order.
        height: Height of a digit, px.
        weight: Thickness of the strokes, px.
        align: Position of the text at `x`: `left`, `right` or `center`.

    Raises:
        ValueError: The text has a character that the font lacks.
    """
    shift = {"left": 0.0, "right": 1.0, "center": 0.5}[align] * text_width(text, height)
    left = round(x - shift - height / _DIGIT_HEIGHT)
    top = round(baseline - _ASCENT * height / _DIGIT_HEIGHT)
    opacity = _mask(text, height, weight)
    opacity = opacity[max(0, -top) : max(0, image.shape[0] - top), max(0, -left) : max(0, image.shape[1] - left)]
    if opacity.size == 0:
        return
    row, column = max(top, 0), max(left, 0)
    patch = image[row : row + opacity.shape[0], column : column + opacity.shape[1]]
    blended = patch + (np.asarray(color, dtype=np.float32) - patch) * opacity
    patch[...] = np.rint(blended)
