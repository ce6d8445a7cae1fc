"""The empty lobby: stone floor in perspective that mirrors the wall a little, glass doors, wood, pools of light."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from servotrack.envs.track.pedestrians.floor import BACK_WALL, Camera

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

BAY = 5.0
"""Doors stand at multiples of this along the back wall, m."""
DOOR_WIDTH, DOOR_HEIGHT = 2.0, 2.4
"""Of the double glass doors, m."""

_FINE = 3  # the wall is painted this much larger than it is seen
_TILE = 1.25
_JOINT = 0.022
_SPOT_SPACING_X, _SPOT_SPACING_Z = 3.4, 3.1
_MIRROR = 0.17  # share of light that the polished floor mirrors at the shallowest angle
_NOISE_SIDE = 256


class _Palette(NamedTuple):
    """Colors of a lobby, RGB."""

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
        camera: Of the scene.
        height: Of the image, px.
        rng: Chooses colors, stones and pictures.

    Returns:
        RGB, shape (height, camera.width, 3).
    """
    palette = _PALETTES[int(rng.integers(len(_PALETTES)))]
    width = int(camera.width)
    foot = camera.horizon + camera.focal * camera.elevation / BACK_WALL
    wall = _paint_wall(camera, foot, palette, rng)
    image = np.empty((height, width, 3), dtype=np.float32)
    rows = min(math.ceil(foot), height)
    image[:rows] = wall[:rows]
    noise = _mottle(rng)
    tones = rng.normal(0.0, 1.0, (64, 64)).astype(np.float32)
    stone = np.array(palette.stone, dtype=np.float32)
    # What the floor mirrors is blurred along the direction that a polished stone smears most.
    mirrored = cv2.GaussianBlur(wall, (0, 0), sigmaX=1.0 * height / 288, sigmaY=4.0 * height / 288)
    _paint_floor(
        image, mirrored, noise, tones, stone, camera.focal, camera.center, camera.horizon, camera.elevation, foot
    )
    _vignette(image)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def background_colors(backdrop: Image, foot: float, rng: np.random.Generator, count: int = 64) -> Array:
    """Colors of the floor where people stand and of the wall behind them, for clothes that are hard to tell from it.

    Args:
        backdrop: As `paint_backdrop` makes it.
        foot: Row of the wall's foot, px.
        rng: Chooses places.
        count: Number of colors.

    Returns:
        Shape (count, 3), gray levels.
    """
    height, width = backdrop.shape[:2]
    smooth = cv2.GaussianBlur(backdrop, (0, 0), 5.0 * height / 288)
    rows = rng.uniform(min(0.9 * foot, 0.5 * height), 0.9 * height, count).astype(int)
    columns = rng.uniform(0.15 * width, 0.85 * width, count).astype(int)
    return smooth[rows, columns].astype(np.float64)


def _mottle(rng: np.random.Generator) -> NDArray[np.float32]:
    """A tile of stone: coarse clouds and fine grains, zero on average, about one in deviation."""
    tile = 0.6 * rng.standard_normal((_NOISE_SIDE, _NOISE_SIDE), dtype=np.float32)
    for cells, strength in ((8, 0.5), (32, 0.6), (96, 0.7)):
        coarse = np.pad(rng.standard_normal((cells, cells), dtype=np.float32), 2, mode="wrap")
        margin = round(2 * _NOISE_SIDE / cells)
        side = _NOISE_SIDE + 2 * margin
        fine = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
        tile += strength * fine[margin : margin + _NOISE_SIDE, margin : margin + _NOISE_SIDE]
    return tile


@njit(cache=True, nogil=True)
def _stone(noise, x, z):  # type: ignore[no-untyped-def]
    """Bilinear in the stone's tile, whose texels are 1.6 cm."""
    u, v = (x + 1024.0) * 62.0, (z + 1024.0) * 62.0
    column, row = int(u), int(v)
    fx, fy = u - column, v - row
    mask = noise.shape[0] - 1
    a, b = row & mask, (row + 1) & mask
    c, d = column & mask, (column + 1) & mask
    upper = noise[a, c] + (noise[a, d] - noise[a, c]) * fx
    lower = noise[b, c] + (noise[b, d] - noise[b, c]) * fx
    return upper + (lower - upper) * fy


@njit(cache=True, nogil=True)
def _joint(place, half_footprint):  # type: ignore[no-untyped-def]
    """Share of a footprint that the joint between two tiles covers; `place` is the distance from a joint, m."""
    reach = max(_JOINT / 2.0 + half_footprint, 1e-6)
    return min(_JOINT / (2.0 * reach), 1.0) * max(0.0, 1.0 - (place / reach) ** 2) * 1.3


@njit(cache=True, nogil=True)
def _paint_floor(image, mirrored, noise, tones, stone, focal, center, horizon, elevation, foot):  # type: ignore[no-untyped-def]
    """Paint the floor's rows, four samples a pixel."""
    height, width = image.shape[0], image.shape[1]
    first = math.floor(foot)
    for i in range(first, height):
        for sub_row in range(2):
            row = i + 0.25 + 0.5 * sub_row
            floor_share = 0.25 if row >= foot else 0.0
            if sub_row == 0 and row < foot:
                for j in range(width):
                    for c in range(3):
                        image[i, j, c] *= 0.5
            elif sub_row == 0:
                for j in range(width):
                    for c in range(3):
                        image[i, j, c] = 0.0
            if floor_share == 0.0:
                continue
            z = focal * elevation / (row - horizon)
            step_x = z / focal
            step_z = z * z / (focal * elevation)
            # Fresnel: the flatter the view, the more of the wall is mirrored.
            steep = elevation / math.hypot(elevation, z)
            mirror = _MIRROR * (0.25 + 0.75 * (1.0 - steep) ** 2 * 1.6)
            wall_height = elevation * (BACK_WALL - z) / z
            wall_row = min(max(foot - wall_height * focal / BACK_WALL, 0.0), foot - 1.0)
            upper = int(wall_row)
            lower = min(upper + 1, mirrored.shape[0] - 1)
            weight = wall_row - upper
            grain = 3.6 / (1.0 + (step_z / 0.05) ** 2 * 0.15)
            band = BACK_WALL - z
            dark_band = 0.45 < band < 0.95
            fade, reach = math.exp(-band / 2.6), 0.19 + 0.05 * band / 2.0
            shade = 1.0 - 0.20 * math.exp(-band / 0.35)
            tz = z / _TILE
            iz = math.floor(tz)
            nearest_z = min(tz - iz, 1.0 - (tz - iz)) * _TILE
            joint_z = _joint(nearest_z, 0.5 * step_z)
            pz = z / _SPOT_SPACING_Z - math.floor(z / _SPOT_SPACING_Z) - 0.5
            for sub_column in range(2):
                for j in range(width):
                    x = (j + 0.25 + 0.5 * sub_column - center) * step_x
                    tx = x / _TILE
                    ix = math.floor(tx)
                    tone = tones[int(iz) & 63, int(ix) & 63]
                    light = 1.0 + 0.022 * tone
                    if (int(ix) + int(iz)) & 1:
                        light *= 0.955
                    nearest_x = min(tx - ix, 1.0 - (tx - ix)) * _TILE
                    joint = max(_joint(nearest_x, 0.5 * step_x), joint_z)
                    if dark_band:
                        light *= 0.80
                        joint = 0.0
                    # Pools under the ceiling's lamps, daylight in front of the doors, shade along the wall.
                    px = x / _SPOT_SPACING_X - math.floor(x / _SPOT_SPACING_X) - 0.5
                    pool = math.exp(-(px * px + pz * pz) * 7.5)
                    door = x / BAY - math.floor(x / BAY + 0.5)
                    beside = (abs(door) - reach) * 42.0
                    daylight = fade / (1.0 + math.exp(beside)) if beside < 40.0 else 0.0
                    level = light * shade * (0.86 + 0.20 * pool + 0.22 * daylight) * (1.0 - 0.30 * joint)
                    speckle = grain * (_stone(noise, x, z) + 0.8 * _stone(noise, 0.21 * z, 0.23 * x + 3.0))
                    for c in range(3):
                        reflected = mirrored[upper, j, c] + (mirrored[lower, j, c] - mirrored[upper, j, c]) * weight
                        tint = 1.0 + (0.05, 0.01, -0.06)[c] * pool - (0.03, 0.0, -0.03)[c] * daylight
                        value = stone[c] * tint * level + speckle * level
                        image[i, j, c] += floor_share * (value + mirror * (reflected - 0.62 * value))


def _paint_wall(camera: Camera, foot: float, palette: _Palette, rng: np.random.Generator) -> NDArray[np.float32]:
    """The back wall down to its foot, as the camera sees it."""
    width, rows = int(camera.width), math.ceil(foot) + 1
    scale = camera.focal / BACK_WALL * _FINE
    canvas = np.empty((rows * _FINE, width * _FINE, 3), dtype=np.float32)
    plaster = np.array(palette.plaster, dtype=np.float32)
    canvas[:] = plaster
    places: list[tuple[int, int, int, int]] = []
    paints: list[tuple[float, ...]] = []

    def box(x0: float, x1: float, y0: float, y1: float, color: NDArray | tuple[float, ...], share: float = 1.0) -> None:
        """A rectangle, m along the wall and m above the floor."""
        left, right = (max(round(camera.center * _FINE + x * scale), 0) for x in (x0, x1))
        top, bottom = (max(round(foot * _FINE - y * scale), 0) for y in (y1, y0))
        if left < min(right, canvas.shape[1]):
            places.append((left, right, top, bottom))
            paints.append((*color, share))

    half = math.ceil(0.5 * width / scale * _FINE / BAY) + 1
    wood, accent = np.array(palette.wood, dtype=np.float64), np.array(palette.accent, dtype=np.float64)
    frame = np.array([46.0, 46.0, 48.0])
    box(-99.0, 99.0, 3.02, 3.14, plaster * 0.72)
    box(-99.0, 99.0, 3.14, 3.20, plaster * 1.08)
    box(-99.0, 99.0, 0.0, 0.16, wood * 0.55)
    for bay in range(-half, half + 1):
        middle = bay * BAY
        _door(box, middle, frame)
        _panel(box, middle + 0.5 * BAY, wood, accent, frame, rng)
    _paint_boxes(canvas, np.array(places), np.array(paints, dtype=np.float32))
    small = cv2.resize(canvas, (width, rows), interpolation=cv2.INTER_AREA)
    # Lamps wash the wall from above.
    across = (np.arange(width) + 0.5 - camera.center) * _FINE / scale
    above = ((foot - np.arange(rows) - 0.5) * _FINE / scale)[:, None]
    beam = np.abs(across / 2.5 - np.round(across / 2.5)) * 2.5
    spread = np.maximum(0.35 + 0.42 * (3.1 - above), 0.05)
    wash = np.where(above < 3.02, np.exp(-((beam / spread) ** 2)) * np.exp(-spread / 1.1), 0.05)
    rough = 1.7 * rng.standard_normal((rows, width), dtype=np.float32)
    lit = small * (0.84 + 0.62 * wash).astype(np.float32)[..., None] + rough[..., None]
    return np.clip(lit, 0.0, 255.0).astype(np.float32)


@njit(cache=True, nogil=True)
def _paint_boxes(canvas, places, paints):  # type: ignore[no-untyped-def]
    """Paint rectangles one over the other: left, right, top, bottom; red, green, blue and how opaque."""
    for i in range(canvas.shape[0]):
        for k in range(len(places)):
            if not places[k, 2] <= i < places[k, 3]:
                continue
            for j in range(places[k, 0], min(places[k, 1], canvas.shape[1])):
                for c in range(3):
                    canvas[i, j, c] += (paints[k, c] - canvas[i, j, c]) * paints[k, 3]


def _door(box, middle: float, frame: Array) -> None:  # type: ignore[no-untyped-def]
    """Double glass doors with a window above; outside is a gray day."""
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
    """Wooden slats between two doors, with a picture, a notice board or a bench before them."""
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


def _vignette(image: NDArray[np.float32]) -> None:
    """Less light towards the corners, as lenses have it."""
    height, width = image.shape[:2]
    y = (np.arange(height) + 0.5 - 0.55 * height) / (0.5 * width)
    x = (np.arange(width) + 0.5 - 0.5 * width) / (0.5 * width)
    kept = 1.0 - 0.13 * (y[:, None] ** 2 + x[None, :] ** 2)
    np.multiply(image, kept[..., None].astype(np.float32), out=image)
