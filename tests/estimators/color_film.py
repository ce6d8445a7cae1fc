"""A plain film for tests of color trackers: a striped red and blue patch on gray noise, its place known exactly."""

from __future__ import annotations

import numpy as np

SHAPE = (120, 160, 3)
SIZE = np.array([24, 32])


def patch(width: int, height: int) -> np.ndarray:
    """Upper half red, lower half blue, with a bright stripe."""
    colors = np.empty((height, width, 3), np.uint8)
    colors[: height // 2], colors[height // 2 :] = (200, 40, 40), (40, 60, 190)
    colors[:, width // 2 - 2 : width // 2 + 2] = (230, 220, 90)
    return colors


def frame(left: int, top: int, seed: int = 0, scale: float = 1.0, hidden: bool = False) -> np.ndarray:
    """A frame with the patch at a place; hidden, a green board covers it."""
    image = np.random.default_rng(seed).integers(90, 130, SHAPE, dtype=np.uint8)
    width, height = np.rint(scale * SIZE).astype(int)
    image[top : top + height, left : left + width] = patch(width, height)
    if hidden:
        image[top - 8 : top + height + 8, left - 8 : left + width + 8] = (40, 150, 60)
    return image


def box(left: int, top: int, scale: float = 1.0) -> np.ndarray:
    """The patch's box in `frame` with the same arguments."""
    return np.array([left, top, *np.rint(scale * SIZE)], dtype=np.float64)


def walk(count: int = 25) -> list[tuple[int, int]]:
    """Places of a patch that goes right and down."""
    return [(20 + 3 * k, 20 + 2 * k) for k in range(count)]


def turned_frame(angle: float, seed: int = 0) -> np.ndarray:
    """A frame with the patch in its middle, turned by an angle (rad) from the right to down, with smooth edges."""
    fine = 4
    image = np.random.default_rng(seed).integers(90, 130, SHAPE, dtype=np.uint8)
    image = image.repeat(fine, axis=0).repeat(fine, axis=1).astype(np.float64)
    rows, columns = (np.mgrid[: image.shape[0], : image.shape[1]] + 0.5) / fine
    x, y = columns - SHAPE[1] / 2, rows - SHAPE[0] / 2
    u, v = np.cos(angle) * x + np.sin(angle) * y + SIZE[0] / 2, np.cos(angle) * y - np.sin(angle) * x + SIZE[1] / 2
    inside = (u >= 0) & (u < SIZE[0]) & (v >= 0) & (v < SIZE[1])
    image[inside] = patch(*SIZE)[v[inside].astype(int), u[inside].astype(int)]
    return image.reshape(SHAPE[0], fine, SHAPE[1], fine, 3).mean(axis=(1, 3)).astype(np.uint8)
