"""Density of clutter over a region: false measurements that come again and again from the same places."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from servotrack.estimators.types import Array, Labels

_CELLS = {2: 16, 3: 8}
"""Cells along each axis, by the number of axes."""
_CHANCE = 1e-3
"""Probability that uniform clutter gets a map."""
_HOT = 10.0
"""Number of points in a cell, in means of all cells, from which clutter may come from there."""


class ClutterMap(NamedTuple):
    """Density of clutter, relative to its mean over the region.

    Attributes:
        low, high: Corners of the region. Shape (d,), m.
        density: Relative density of each cell, with a mean of 1. Shape (g,) * d.
    """

    low: Array
    high: Array
    density: Array

    def __call__(self, places: Array) -> Array:
        """Relative density at positions (k, d), that of the nearest cell outside of the region. Shape (k,)."""
        return np.asarray(self.density[_cells(places, self.low, self.high)], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MappedClutter:
    """Clutter intensity of a set filter, a function of the measurement.

    Args:
        intensity: Mean intensity, per unit of measurement space.
        relative: The map.
    """

    intensity: float
    relative: ClutterMap

    def __call__(self, places: Array) -> Array:
        """Intensity at positions (k, d). Shape (k,)."""
        return self.intensity * self.relative(places)


def clutter_map(places: Array, low: Array, high: Array) -> ClutterMap | None:
    """Measure the density of clutter from false points; None if they may be uniform.

    Counts of cells are drawn toward their mean, the more the less they differ (gamma prior, by moments).

    Args:
        places: Positions of the false points. Shape (k, d).
        low: Lower corner of the region. Shape (d,).
        high: Upper corner. Shape (d,).
    """
    counts = _counts(places, low, high)
    mean = float(counts.mean())
    if mean == 0.0 or float(((counts - mean) ** 2).sum()) / mean <= float(chdtri(counts.size - 1, _CHANCE)):
        return None
    variance = float(counts.var(ddof=1))
    prior = mean**2 / max(variance - mean, 1e-9 * mean)
    return ClutterMap(low, high, (counts + prior) / (mean + prior))


def may_be_mapped(places: Array, low: Array, high: Array) -> bool:
    """Return True if some place has so many points that clutter, or a target that rests, comes from there."""
    counts = _counts(places, low, high)
    return bool(counts.max() >= _HOT * counts.mean())


def _cells(places: Array, low: Array, high: Array) -> tuple[Labels, ...]:
    """Index of the cell of each position, one array per axis."""
    cells = _CELLS[len(low)]
    index = np.floor((places - low) / (high - low) * cells)
    return tuple(np.clip(index, 0, cells - 1).astype(np.int64).T)


def _counts(places: Array, low: Array, high: Array) -> Array:
    shape = (_CELLS[len(low)],) * len(low)
    at = np.ravel_multi_index(_cells(places, low, high), shape)
    return np.bincount(at, minlength=math.prod(shape)).reshape(shape).astype(np.float64)
