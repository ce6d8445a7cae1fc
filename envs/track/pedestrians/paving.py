"""Rendering of the stone floor in perspective, with reflections of the wall, lamps and daylight."""

from __future__ import annotations

import math

import cv2
import numpy as np

from servotrack.envs.track.pedestrians.floor import BACK_WALL, BAY, Camera
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import FloatArray

_TILE = 1.25  # side of a stone tile, m
_JOINT = 0.022  # width of the joints, m
_SPOT_SPACING_X, _SPOT_SPACING_Z = 3.4, 3.1  # distances between the lamps, m
_MIRROR = 0.17  # strength of the reflection of the wall in the polished floor
_NOISE_SIDE = 256
_TINTS = np.array([[0.05, 0.03], [0.01, 0.0], [-0.06, -0.03]])
"""For each channel: relative increase by lamps, and decrease by daylight."""


def paint_floor(
    image: FloatArray,
    wall: FloatArray,
    stone: tuple[int, int, int],
    camera: Camera,
    foot: float,
    rng: np.random.Generator,
) -> None:
    """Paint the rows of the floor in an image, with four samples per pixel.

    Args:
        image: RGB image, shape (H, W, 3); the rows below the foot of the wall are painted.
        wall: Wall that the floor reflects, shape (rows, W, 3).
        stone: Color of the stone.
        camera: Camera of the scene.
        foot: Row of the foot of the wall, px.
        rng: Generator of the stones.
    """
    noise = _mottle(rng)
    tones = rng.normal(0.0, 1.0, (64, 64)).astype(np.float32)
    # The reflection is blurred, mostly vertically, as by polished stone.
    blur = len(image) / 288
    mirrored = cv2.GaussianBlur(wall, (0, 0), sigmaX=1.0 * blur, sigmaY=4.0 * blur)
    channels = np.ascontiguousarray(mirrored.transpose(2, 0, 1))
    color = np.array(stone, dtype=np.float32)
    focal, center, horizon, elevation = camera.focal, camera.center, camera.horizon, camera.elevation
    _paint(image, channels, noise, tones, color, _TINTS, focal, center, horizon, elevation, foot)


def _mottle(rng: np.random.Generator) -> FloatArray:
    """Return a stone texture of coarse clouds and fine grain, with mean 0 and a standard deviation of about 1."""
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
    """Sample the stone texture bilinearly; a texel is 1.6 cm."""
    u, v = (x + 1024.0) * 62.0, (z + 1024.0) * 62.0
    column, row = int(u), int(v)
    fx, fy = u - column, v - row
    mask = _NOISE_SIDE - 1
    a, b = row & mask, (row + 1) & mask
    c, d = column & mask, (column + 1) & mask
    upper = noise[a, c] + (noise[a, d] - noise[a, c]) * fx
    lower = noise[b, c] + (noise[b, d] - noise[b, c]) * fx
    return upper + (lower - upper) * fy


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _joint(place, half_footprint):  # type: ignore[no-untyped-def]
    """Return the share of a pixel's footprint covered by a joint at the distance `place`, m."""
    reach = max(_JOINT / 2.0 + half_footprint, 1e-6)
    return min(_JOINT / (2.0 * reach), 1.0) * max(0.0, 1.0 - (place / reach) ** 2) * 1.3


@njit(cache=True, nogil=True, inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """Exponential function on -13 to 13 with an error of about 1e-15. Unlike the library's, it vectorizes."""
    y = x / 16.0
    series = 1.0
    for term in range(14, 0, -1):
        series = 1.0 + (1.0 / term) * y * series
    series *= series
    series *= series
    series *= series
    return series * series


@njit(cache=True, nogil=True, error_model="numpy")
def _light_row(start, step, pz, joint_z, fade, reach, dark, light, level):  # type: ignore[no-untyped-def]
    """Compute lamp light, daylight and their sum on the samples of one row, at x = (j + start) * step."""
    lamps, day = light[0], light[1]
    for j in range(len(level)):
        x = (j + start) * step
        tx = x / _TILE
        ix = np.floor(tx)
        joint = max(_joint(min(tx - ix, 1.0 - (tx - ix)) * _TILE, 0.5 * step), joint_z)
        # Pools under the ceiling's lamps, and daylight in front of the doors.
        px = x / _SPOT_SPACING_X - np.floor(x / _SPOT_SPACING_X) - 0.5
        lamps[j] = _exp(-(px * px + pz * pz) * 7.5)
        door = x / BAY - np.floor(x / BAY + 0.5)
        day[j] = fade / (1.0 + _exp((abs(door) - reach) * 42.0))
        level[j] = (0.86 + 0.20 * lamps[j] + 0.22 * day[j]) * (1.0 if dark else 1.0 - 0.30 * joint)


@njit(cache=True, nogil=True)
def _stone_row(start, step, z, iz, dim, grain, noise, tones, level, speckle):  # type: ignore[no-untyped-def]
    """Apply tile tones to the light `level` of one row, in place, and compute the speckles of the stone."""
    for j in range(len(level)):
        x = (j + start) * step
        ix = math.floor(x / _TILE)
        light = 1.0 + 0.022 * tones[iz & 63, ix & 63]
        if (ix + iz) & 1:
            light *= 0.955
        level[j] *= light * dim
        speckle[j] = grain * (_stone(noise, x, z) + 0.8 * _stone(noise, 0.21 * z, 0.23 * x + 3.0)) * level[j]


@njit(cache=True, nogil=True)
def _add_row(stone, tint, light, level, speckle, reflected, mirror, out):  # type: ignore[no-untyped-def]
    """Add one sample (a quarter) to one channel of a row of pixels."""
    for j in range(len(out)):
        value = stone * (1.0 + tint[0] * light[0, j] - tint[1] * light[1, j]) * level[j] + speckle[j]
        out[j] += 0.25 * (value + mirror * (reflected[j] - 0.62 * value))


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(image, mirrored, noise, tones, stone, tints, focal, center, horizon, elevation, foot):  # type: ignore[no-untyped-def]
    height, width = image.shape[0], image.shape[1]
    # Buffers of one row, channel by channel: sums over the samples, and reflected light.
    sums, reflected = np.empty((3, width), np.float32), np.empty((3, width))
    light, level, speckle = np.empty((2, width)), np.empty(width), np.empty(width)
    # Rows whose samples all lie on the wall are skipped.
    for i in range(math.ceil(foot - 0.75), height):
        for sub_row in range(2):
            row = i + 0.25 + 0.5 * sub_row
            if sub_row == 0:
                # A row divided by the foot of the wall keeps half of the wall.
                for c in range(3):
                    for j in range(width):
                        sums[c, j] = 0.5 * image[i, j, c] if row < foot else 0.0
            if row < foot:
                continue
            z = focal * elevation / (row - horizon)
            step_x = z / focal
            step_z = z * z / (focal * elevation)
            # Fresnel: a flatter view reflects more of the wall.
            steep = elevation / math.hypot(elevation, z)
            mirror = _MIRROR * (0.25 + 0.75 * (1.0 - steep) ** 2 * 1.6)
            wall_height = elevation * (BACK_WALL - z) / z
            wall_row = min(max(foot - wall_height * focal / BACK_WALL, 0.0), foot - 1.0)
            upper = int(wall_row)
            lower = min(upper + 1, mirrored.shape[1] - 1)
            weight = wall_row - upper
            grain = 3.6 / (1.0 + (step_z / 0.05) ** 2 * 0.15)
            band = BACK_WALL - z
            dark_band = 0.45 < band < 0.95
            fade, reach = math.exp(-band / 2.6), 0.19 + 0.05 * band / 2.0
            dim = 1.0 - 0.20 * math.exp(-band / 0.35)  # shade along the wall
            if dark_band:
                dim *= 0.80
            tz = z / _TILE
            iz = math.floor(tz)
            joint_z = _joint(min(tz - iz, 1.0 - (tz - iz)) * _TILE, 0.5 * step_z)
            pz = z / _SPOT_SPACING_Z - math.floor(z / _SPOT_SPACING_Z) - 0.5
            for c in range(3):
                far, near = mirrored[c, upper], mirrored[c, lower]
                for j in range(width):
                    reflected[c, j] = far[j] + (near[j] - far[j]) * weight
            for sub_column in range(2):
                start = 0.25 + 0.5 * sub_column - center
                _light_row(start, step_x, pz, joint_z, fade, reach, dark_band, light, level)
                _stone_row(start, step_x, z, iz, dim, grain, noise, tones, level, speckle)
                for c in range(3):
                    _add_row(stone[c], tints[c], light, level, speckle, reflected[c], mirror, sums[c])
        for c in range(3):
            for j in range(width):
                image[i, j, c] = sums[c, j]
