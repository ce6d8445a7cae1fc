"""Palette of all pictures, and helpers for panels, mixed colors and sub-pixel coordinates."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.types import Array

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

PAPER: Color = (250, 248, 244)
FLOOR: Color = (236, 231, 222)
FLOOR_GRID: Color = (222, 215, 203)
INK: Color = (38, 50, 64)
SOFT_INK: Color = (128, 136, 144)
IVORY: Color = (253, 252, 249)
VERMILION: Color = (226, 85, 52)
TEAL: Color = (20, 126, 130)


class Panel(NamedTuple):
    """A rectangle of the picture, px."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: NDArray) -> NDArray:
        """View of the panel's part of an image."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


@lru_cache(maxsize=256)
def mix(a: Color, b: Color, weight: float) -> Color:
    """Interpolate between the colors `a` (weight 0) and `b` (weight 1)."""
    red, green, blue = (round(x + (y - x) * weight) for x, y in zip(a, b, strict=True))
    return (red, green, blue)


def fixed_point(points: Array) -> NDArray[np.int32]:
    """Convert pixel coordinates (..., 2) to OpenCV's sub-pixel integers with four fractional bits.

    Values are clipped far outside of any image, because OpenCV overflows beyond.
    """
    scaled = np.rint(np.multiply(points, 16.0))
    return np.minimum(np.maximum(scaled, -64000.0), 64000.0).astype(np.int32)
