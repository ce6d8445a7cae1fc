"""Texture of a concrete floor: one seamless tile and its mipmap levels, painted once per process."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from servotrack.estimators.types import FloatArray

SIDE = 512
"""Width and height of the tile at the finest level, texels; a power of two."""
TILE = 1.024
"""Width and height of the tile on the floor, m."""

# Cells per tile, and standard deviation of the brightness.
_OCTAVES = ((4, 0.05), (9, 0.06), (23, 0.06), (61, 0.055), (149, 0.05), (331, 0.045))
_SLAB = 256  # texels between two joints
_SPECKS, _SCRATCHES = 900, 26


@lru_cache(maxsize=1)
def floor_texture() -> FloatArray:
    """Paint the floor: clouds at several scales, joints between slabs, specks of gravel and a few scratches.

    Returns:
        Mipmap of the tile, brightness about 1, flat float32. The level with s texels a side begins at texel s * s, row
        by row. Each texel is stored together with its neighbors, what bilinear interpolation needs side by side in
        memory: itself, the one to the right, the one below, the one below to the right.
    """
    rng = np.random.default_rng(2011)
    tile = np.ones((SIDE, SIDE), dtype=np.float32)
    for cells, strength in _OCTAVES:
        tile += _cloud(rng, cells, strength)
    for k in range(_SPECKS + _SCRATCHES):
        x, y = rng.uniform(0, SIDE, 2)
        angle, shade = rng.uniform(0, np.pi), rng.choice([-0.22, -0.12, 0.16])
        length = 0.0 if k < _SPECKS else rng.uniform(20, 110)
        _stroke(tile, x, y, length * np.cos(angle), length * np.sin(angle), rng.uniform(0.6, 2.2), shade)
    joint = np.abs((np.arange(SIDE) + _SLAB // 2) % _SLAB - _SLAB // 2)
    dark = 1.0 - 0.45 * np.clip(2.5 - joint, 0.0, 1.0).astype(np.float32)
    tile = np.clip(tile * dark[:, None] * dark[None, :], 0.25, 1.7).astype(np.float32)
    corners = np.zeros((2 * SIDE * SIDE, 4), np.float32)
    while True:
        below = np.roll(tile, -1, axis=0)
        around = np.stack([tile, np.roll(tile, -1, axis=1), below, np.roll(below, -1, axis=1)], axis=-1)
        corners[tile.size : 2 * tile.size] = around.reshape(-1, 4)
        if len(tile) == 1:
            return corners.ravel()
        tile = 0.25 * (tile[::2, ::2] + tile[1::2, ::2] + tile[::2, 1::2] + tile[1::2, 1::2])


def _cloud(rng: np.random.Generator, cells: int, strength: float) -> FloatArray:
    """Smooth seamless noise with `cells` cells a side."""
    values = rng.standard_normal((cells, cells)).astype(np.float32)
    border = 4
    # Wrapped before enlarging, so that the interpolation is seamless.
    wrapped = np.pad(values, border, mode="wrap")
    place = ((np.arange(SIDE, dtype=np.float32) + 0.5) * (cells / SIDE) - 0.5 + border).astype(np.float32)
    columns, rows = np.meshgrid(place, place)
    return strength * cv2.remap(wrapped, columns, rows, cv2.INTER_CUBIC)


def _stroke(tile: FloatArray, x: float, y: float, dx: float, dy: float, radius: float, shade: float) -> None:
    """Add a soft dot or line that wraps around the tile's borders."""
    pad = int(radius + 3)
    low_x, high_x = int(min(x, x + dx)) - pad, int(max(x, x + dx)) + pad
    low_y, high_y = int(min(y, y + dy)) - pad, int(max(y, y + dy)) + pad
    columns, rows = np.meshgrid(np.arange(low_x, high_x), np.arange(low_y, high_y))
    along = np.clip(((columns - x) * dx + (rows - y) * dy) / max(dx * dx + dy * dy, 1e-9), 0.0, 1.0)
    distance = np.hypot(columns - x - along * dx, rows - y - along * dy)
    tile[rows % SIDE, columns % SIDE] += (shade * np.clip(radius + 0.5 - distance, 0.0, 1.0)).astype(np.float32)
