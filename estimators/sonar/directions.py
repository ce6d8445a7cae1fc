"""Differences of bearings: from 0 to 180 deg beside a line, or around the circle of a planar array."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array


class Directions(NamedTuple):
    """Geometry of the bearings of an array.

    Attributes:
        planar: The array tells bearings over 360 deg apart; False for a line, whose resolution follows the cosine.
        circle: The grid of bearings closes after 360 deg.
    """

    planar: bool = False
    circle: bool = False

    def difference(self, one: ArrayLike, other: ArrayLike) -> Array:
        """Difference of two bearings, the shorter way around a circle, deg."""
        plain = np.asarray(one, np.float64) - np.asarray(other, np.float64)
        return np.asarray((plain + 180.0) % 360.0 - 180.0) if self.circle else plain

    def apart(self, one: ArrayLike, other: ArrayLike) -> Array:
        """Distance of two bearings as an array resolves it: of the cosines beside a line, else of the unit vectors."""
        a, b = np.radians(np.asarray(one, np.float64)), np.radians(np.asarray(other, np.float64))
        return np.asarray(2.0 * np.abs(np.sin(0.5 * (a - b))) if self.planar else np.abs(np.cos(a) - np.cos(b)))

    def unwrapped(self, bearings: Array) -> Array:
        """Bearings without jumps by 360 deg. Shape (T,)."""
        return np.unwrap(bearings, period=360.0) if self.circle and len(bearings) else bearings

    def turn(self, one: float, other: float) -> float:
        """Whole turns that bring `other` next to `one`, deg; 0 unless the grid closes."""
        return 360.0 * round((one - other) / 360.0) if self.circle else 0.0

    def wrapped(self, bearings: Array) -> Array:
        """Bearings from 0 to 360 deg if the grid closes, else unchanged."""
        return np.asarray(bearings % 360.0) if self.circle else bearings


LINE = Directions()
"""Directions of a line array."""
