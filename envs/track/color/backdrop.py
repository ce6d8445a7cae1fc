"""Random background of color tracking scenes: a room with shelves, pictures, wood panels and plants."""

from __future__ import annotations

import cv2
import numpy as np

from servotrack.envs.track.color.layers import Color
from servotrack.estimators.types import Array, FloatArray, Image

_WALLS = ((196, 188, 172), (168, 180, 184), (188, 176, 190), (174, 186, 164), (206, 194, 160), (150, 152, 158))
_WOODS = ((150, 106, 68), (120, 80, 52), (178, 136, 92), (98, 72, 54))
_SPINES = (
    (146, 44, 44), (38, 72, 118), (66, 106, 70), (200, 170, 96), (84, 60, 96), (50, 52, 58), (218, 208, 190),
    (176, 96, 52), (70, 128, 134),
)  # fmt: skip


def paint_backdrop(
    rng: np.random.Generator, width: int, height: int, own: tuple[Color, ...], camouflage: float
) -> Image:
    """Paint a room.

    Args:
        rng: Random generator of the room.
        width: Width of the picture, px.
        height: Height of the picture, px.
        own: Colors of the target, used for camouflage.
        camouflage: Share of objects that have one of these colors, 0 to 1.

    Returns:
        RGB image, shape (height, width, 3), uint8.
    """
    image = np.empty((height, width, 3), np.float32)
    image[:] = _tint(rng, _WALLS)
    broad = cv2.resize(rng.standard_normal((5, 7)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    image *= (1.0 + 0.07 * broad)[..., None]
    _wallpaper(image, rng)
    left = -int(rng.integers(0, 50))
    while left < width:
        span = int(rng.integers(50, 120))
        _PIECES[int(rng.integers(len(_PIECES)))](image, rng, left, span, own, camouflage)
        left += span + int(rng.integers(4, 34))
    image *= 1.0 + 0.035 * rng.standard_normal((height, width, 1)).astype(np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _tint(rng: np.random.Generator, palette: tuple[Color, ...]) -> Array:
    return np.array(palette[int(rng.integers(len(palette)))]) * rng.uniform(0.85, 1.12, 3)


def _thing(rng: np.random.Generator, palette: tuple[Color, ...], own: tuple[Color, ...], camouflage: float) -> Array:
    """Return a color of the palette or, with probability `camouflage`, of the target."""
    if rng.random() < camouflage:
        return np.array(own[int(rng.integers(len(own)))]) * rng.uniform(0.92, 1.08)
    return _tint(rng, palette)


def _box(image: FloatArray, left: float, top: float, width: float, height: float, color: Array) -> None:
    left, top, right, bottom = round(left), round(top), round(left + width), round(top + height)
    image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = color


def _wallpaper(image: FloatArray, rng: np.random.Generator) -> None:
    kind, step = int(rng.integers(3)), int(rng.integers(12, 30))
    height, width = image.shape[:2]
    if kind == 0:
        image[:, np.arange(width) % step < step // 3] *= 0.93
    elif kind == 1:
        rows, columns = np.mgrid[:height, :width]
        image[(rows % step - step // 2) ** 2 + (columns % step - step // 2) ** 2 < (step // 5) ** 2] *= 0.88
    else:
        image[np.arange(height) % step < 2] *= 0.85
        shift = (np.arange(height) // step % 2) * step
        mortar = (np.arange(width)[None, :] + shift[:, None]) % (2 * step) < 2
        image[mortar] *= 0.85


def _shelf(
    image: FloatArray, rng: np.random.Generator, left: int, span: int, own: tuple[Color, ...], share: float
) -> None:
    wood = _tint(rng, _WOODS)
    height = image.shape[0]
    top = int(rng.integers(0, height // 3))
    _box(image, left, top, span, height - top, 0.55 * wood)
    row = top + 4
    while row < height:
        tall = int(rng.integers(34, 56))
        at = left + 4
        while at < left + span - 8:
            thick, lower = int(rng.integers(4, 13)), int(rng.integers(0, 12))
            color = _thing(rng, _SPINES, own, share)
            thick = min(thick, left + span - 4 - at)
            _box(image, at, row + lower, thick, tall - lower, color)
            _box(image, at, row + lower, 1, tall - lower, 0.6 * color)
            _box(image, at + 1, row + lower + 6, thick - 2, 3, 0.5 * color + 110.0)
            at += thick
        _box(image, left, row + tall, span, 4, wood)
        row += tall + 8
    for edge in (left, left + span - 3):
        _box(image, edge, top, 3, height - top, 0.8 * wood)


def _picture(
    image: FloatArray, rng: np.random.Generator, left: int, span: int, own: tuple[Color, ...], share: float
) -> None:
    for _ in range(3):
        wide, tall = span * rng.uniform(0.5, 1.0), rng.uniform(36.0, 90.0)
        top = rng.uniform(0.0, image.shape[0] - 60.0)
        _box(image, left, top, wide, tall, _tint(rng, _WOODS))
        _box(image, left + 4, top + 4, wide - 8, tall - 8, _thing(rng, _SPINES, own, share))
        for _ in range(5):
            center = (round(left + wide * rng.uniform(0.2, 0.8)), round(top + tall * rng.uniform(0.2, 0.8)))
            radius = round(min(wide, tall) * rng.uniform(0.06, 0.18))
            cv2.circle(image, center, radius, _thing(rng, _SPINES, own, share).tolist(), -1)


def _panel(
    image: FloatArray, rng: np.random.Generator, left: int, span: int, own: tuple[Color, ...], share: float
) -> None:
    wood = _thing(rng, _WOODS, own, share)
    height = image.shape[0]
    top = int(rng.integers(0, 60))
    _box(image, left, top, span, height - top, wood)
    first, last = max(left, 0), min(left + span, image.shape[1])
    if last > first:
        grain = rng.standard_normal((1, last - first, 1)) + 0.6 * np.cumsum(
            0.12 * rng.standard_normal((height - top, last - first, 1)), axis=0
        )
        image[top:, first:last] *= 1.0 + 0.05 * np.clip(grain, -3.0, 3.0).astype(np.float32)
    for k in range(3):
        _box(image, left + 8, top + 8 + k * 0.33 * height, span - 16, 2, 0.6 * wood)


def _plant(
    image: FloatArray, rng: np.random.Generator, left: int, span: int, own: tuple[Color, ...], share: float
) -> None:
    height = image.shape[0]
    root = np.array([left + span / 2.0, height * rng.uniform(0.55, 0.95)])
    _box(image, root[0] - 13, root[1] - 4, 26, 30, _thing(rng, _SPINES, own, share))
    for _ in range(46):
        angle, length = rng.uniform(-2.9, -0.25), rng.uniform(25.0, 95.0)
        tip = root + length * np.array([0.8 * np.cos(angle), np.sin(angle)])
        middle = (root + tip) / 2.0 + rng.uniform(-7.0, 7.0, 2)
        green = np.array([58.0, 104.0, 52.0]) * rng.uniform(0.6, 1.4)
        leaf = np.rint(root + np.array([(0.0, 0.0), middle - root, tip - root])).astype(np.int32)
        cv2.fillPoly(image, [leaf], green.tolist())


_PIECES = (_shelf, _picture, _panel, _plant)
