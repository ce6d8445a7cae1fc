"""Rendering of the empty lobby: wall with glass doors, wood panels and lamps, above a reflecting stone floor."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.pedestrians.floor import BACK_WALL, BAY, Camera
from servotrack.envs.track.pedestrians.paving import paint_floor
from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import exponential
from servotrack.estimators.types import Array, FloatArray, Image

DOOR_WIDTH, DOOR_HEIGHT = 2.0, 2.4
"""Size of the double glass doors, m."""

_SUPERSAMPLING = 3  # subpixels per pixel and axis with which the wall is painted


class _Palette(NamedTuple):
    """RGB colors of a lobby."""

    stone: tuple[int, int, int]
    plaster: tuple[int, int, int]
    wood: tuple[int, int, int]
    accent: tuple[int, int, int]


_PALETTES = (
    _Palette((158, 148, 133), (176, 166, 150), (118, 84, 56), (44, 86, 98)),
    _Palette((146, 150, 150), (168, 170, 168), (104, 82, 64), (136, 62, 44)),
    _Palette((162, 150, 128), (164, 160, 150), (92, 70, 54), (52, 78, 60)),
    _Palette((150, 146, 142), (178, 170, 156), (128, 96, 66), (62, 66, 104)),
)


def paint_backdrop(camera: Camera, height: int, rng: np.random.Generator) -> Image:
    """Paint an empty lobby.

    Args:
        camera: Camera of the scene.
        height: Height of the image, px.
        rng: Generator of colors, stones and pictures.

    Returns:
        RGB image, shape (height, camera.width, 3), uint8.
    """
    palette = _PALETTES[int(rng.integers(len(_PALETTES)))]
    width = int(camera.width)
    foot = camera.horizon + camera.focal * camera.elevation / BACK_WALL
    wall = _paint_wall(camera, foot, palette, rng)
    image = np.empty((height, width, 3), dtype=np.float32)
    rows = min(math.ceil(foot), height)
    image[:rows] = wall[:rows]
    paint_floor(image, wall, palette.stone, camera, foot, rng)
    backdrop = np.empty((height, width, 3), dtype=np.uint8)
    _apply_vignetting(image, backdrop)
    return backdrop


def background_colors(backdrop: Image, foot: float, rng: np.random.Generator, count: int = 64) -> Array:
    """Sample colors of floor and wall, for camouflaged clothes.

    Args:
        backdrop: Image made by `paint_backdrop`.
        foot: Row of the foot of the wall, px.
        rng: Generator of the places.
        count: Number of colors.

    Returns:
        RGB colors, shape (count, 3), gray levels.
    """
    height, width = backdrop.shape[:2]
    smooth = cv2.GaussianBlur(backdrop, (0, 0), 5.0 * height / 288)
    rows = rng.uniform(min(0.9 * foot, 0.5 * height), 0.9 * height, count).astype(int)
    columns = rng.uniform(0.15 * width, 0.85 * width, count).astype(int)
    return smooth[rows, columns].astype(np.float64)


def _paint_wall(camera: Camera, foot: float, palette: _Palette, rng: np.random.Generator) -> FloatArray:
    """Paint the back wall, down to its foot, in the image of the camera."""
    width, rows = int(camera.width), math.ceil(foot) + 1
    scale = camera.focal / BACK_WALL * _SUPERSAMPLING
    middle_column, foot_row, last_column = camera.center * _SUPERSAMPLING, foot * _SUPERSAMPLING, width * _SUPERSAMPLING
    plaster = np.array(palette.plaster, dtype=np.float32)
    places: list[tuple[int, int, int, int]] = []
    paints: list[tuple[float, ...]] = []

    def box(x0: float, x1: float, y0: float, y1: float, color: NDArray | tuple[float, ...], share: float = 1.0) -> None:
        """Add a rectangle, in m along the wall and m above the floor."""
        left, right = max(round(middle_column + x0 * scale), 0), max(round(middle_column + x1 * scale), 0)
        if left < min(right, last_column):
            top, bottom = max(round(foot_row - y1 * scale), 0), max(round(foot_row - y0 * scale), 0)
            places.append((left, min(right, last_column), top, bottom))
            paints.append((*color, share))

    half = math.ceil(0.5 * width / scale * _SUPERSAMPLING / BAY) + 1
    wood, accent = np.array(palette.wood, dtype=np.float64), np.array(palette.accent, dtype=np.float64)
    frame = np.array([46.0, 46.0, 48.0])
    box(-99.0, 99.0, 3.02, 3.14, plaster * 0.72)
    box(-99.0, 99.0, 3.14, 3.20, plaster * 1.08)
    box(-99.0, 99.0, 0.0, 0.16, wood * 0.55)
    for bay in range(-half, half + 1):
        middle = bay * BAY
        _door(box, middle, frame)
        _panel(box, middle + 0.5 * BAY, wood, accent, frame, rng)
    # Lamps light the wall from above.
    across = (np.arange(width) + 0.5 - camera.center) * _SUPERSAMPLING / scale
    above = ((foot - np.arange(rows) - 0.5) * _SUPERSAMPLING / scale)[:, None]
    beam = np.abs(across / 2.5 - np.round(across / 2.5)) * 2.5
    spread = np.maximum(0.35 + 0.42 * (3.1 - above), 0.05)
    wash = np.where(above < 3.02, exponential(-((beam / spread) ** 2)) * exponential(-spread / 1.1), 0.05)
    light = (0.84 + 0.62 * wash).astype(np.float32)
    rough = 1.7 * rng.standard_normal((rows, width), dtype=np.float32)
    wall = np.empty((rows, width, 3), dtype=np.float32)
    _paint_boxes(plaster, np.array(places), np.array(paints, dtype=np.float32), light, rough, wall)
    return wall


@njit(cache=True, nogil=True)
def _paint_boxes(plaster, places, paints, light, rough, wall):  # type: ignore[no-untyped-def]
    """Paint rectangles onto plaster with 3 x 3 subpixels per pixel, average them and apply the light.

    Args:
        plaster: Color of the plaster.
        places: Left, right, top, bottom of each rectangle in subpixels, shape (k, 4).
        paints: Red, green, blue and opacity of each rectangle, shape (k, 4).
        light: Factor on the brightness of each pixel, shape (rows, width).
        rough: Offset by the grain of the plaster, shape (rows, width).
        wall: Output image, shape (rows, width, 3).
    """
    fine = np.empty((_SUPERSAMPLING, wall.shape[1] * _SUPERSAMPLING, 3), np.float32)
    share = np.float32(1.0 / _SUPERSAMPLING**2)
    for i in range(wall.shape[0]):
        for sub in range(_SUPERSAMPLING):
            for j in range(fine.shape[1]):
                for c in range(3):
                    fine[sub, j, c] = plaster[c]
            for k in range(len(places)):
                if not places[k, 2] <= _SUPERSAMPLING * i + sub < places[k, 3]:
                    continue
                for j in range(places[k, 0], places[k, 1]):
                    for c in range(3):
                        fine[sub, j, c] += (paints[k, c] - fine[sub, j, c]) * paints[k, 3]
        for j in range(wall.shape[1]):
            for c in range(3):
                # Same order of additions as OpenCV's INTER_AREA, for the same rounding.
                x = _SUPERSAMPLING * j
                first = fine[0, x, c] + fine[0, x + 1, c] + fine[0, x + 2, c] + fine[1, x, c]
                second = fine[1, x + 1, c] + fine[1, x + 2, c] + fine[2, x, c] + fine[2, x + 1, c]
                lit = (first + second + fine[2, x + 2, c]) * share * light[i, j] + rough[i, j]
                wall[i, j, c] = min(max(lit, np.float32(0.0)), np.float32(255.0))


def _door(box, middle: float, frame: Array) -> None:  # type: ignore[no-untyped-def]
    """Paint double glass doors with a window above and gray daylight outside."""
    half = DOOR_WIDTH / 2.0
    box(middle - half - 0.1, middle + half + 0.1, 0.0, 2.96, frame)
    for side in (-1.0, 1.0):
        near, far = sorted((middle + side * 0.05, middle + side * (half - 0.04)))
        for step in range(12):
            low, high = 0.12 + step * 0.19, 0.12 + (step + 1) * 0.19
            share = step / 11.0
            outside = np.array([150.0, 158.0, 152.0]) * (1.0 - share) + np.array([196.0, 208.0, 216.0]) * share
            box(near, far, low, high, outside)
        box(near, far, 0.12, 0.9, (120.0, 132.0, 118.0), 0.45)
        box(near + 0.25, near + 0.42, 0.12, 2.4, (255.0, 255.0, 255.0), 0.22)
        box(middle + side * 0.13 - 0.025, middle + side * 0.13 + 0.025, 0.8, 1.5, (210.0, 208.0, 200.0))
        box(near, far, 2.5, 2.88, (204.0, 214.0, 220.0))
    box(middle - half, middle + half, 1.02, 1.10, (236.0, 240.0, 240.0), 0.55)


def _panel(box, middle: float, wood: Array, accent: Array, frame: Array, rng: np.random.Generator) -> None:  # type: ignore[no-untyped-def]
    """Paint wooden slats between two doors, with a picture or notice board, and a bench."""
    left, right = middle - 1.3, middle + 1.3
    box(left - 0.05, right + 0.05, 0.16, 2.86, wood * 0.55)
    slats = 13
    for slat in range(slats):
        x = left + (right - left) * slat / slats
        box(x + 0.015, x + (right - left) / slats - 0.015, 0.2, 2.82, wood * rng.uniform(0.9, 1.12))
    kind = int(rng.integers(4))
    if kind == 0:
        box(middle - 0.62, middle + 0.62, 1.2, 2.2, frame)
        box(middle - 0.56, middle + 0.56, 1.26, 2.14, (222.0, 216.0, 204.0))
        for _ in range(5):
            x, y = rng.uniform(-0.42, 0.1), rng.uniform(1.34, 1.8)
            tint = accent * rng.uniform(0.7, 2.0) + rng.uniform(0, 30, 3)
            box(middle + x, middle + x + rng.uniform(0.1, 0.38), y, y + rng.uniform(0.08, 0.3), tint)
    elif kind == 1:
        box(middle - 0.9, middle + 0.9, 1.05, 2.3, accent)
        for line in range(5):
            y = 2.08 - 0.2 * line
            box(middle - 0.74, middle - 0.74 + rng.uniform(0.6, 1.4), y, y + 0.07, (232.0, 230.0, 222.0), 0.85)
    elif kind == 2:
        for offset in (-0.62, 0.0, 0.62):
            box(middle + offset - 0.24, middle + offset + 0.24, 1.3, 2.0, frame)
            tint = rng.uniform(110, 215, 3)
            box(middle + offset - 0.2, middle + offset + 0.2, 1.34, 1.96, tint)
            box(middle + offset - 0.2, middle + offset + 0.2, 1.34, 1.34 + rng.uniform(0.15, 0.4), tint * 0.6)
    box(middle - 1.05, middle + 1.05, 0.40, 0.50, wood * 0.42 + 12.0)
    box(middle - 1.05, middle + 1.05, 0.48, 0.52, wood * 0.9 + 40.0)
    for x in (-0.85, 0.85):
        box(middle + x - 0.04, middle + x + 0.04, 0.02, 0.42, frame)


@njit(cache=True, nogil=True)
def _apply_vignetting(image, out):  # type: ignore[no-untyped-def]
    """Apply vignetting and round to gray levels."""
    height, width = image.shape[0], image.shape[1]
    for i in range(height):
        y = (i + 0.5 - 0.55 * height) / (0.5 * width)
        for j in range(width):
            x = (j + 0.5 - 0.5 * width) / (0.5 * width)
            kept = np.float32(1.0 - 0.13 * (y * y + x * x))
            for c in range(3):
                out[i, j, c] = np.uint8(min(max(np.rint(image[i, j, c] * kept), 0.0), 255.0))
