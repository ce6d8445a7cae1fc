"""What targets explain of a record: their spectra as beam patterns, their powers, and how far both can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.optimize import nnls

from servotrack.estimators.sonar.array import Band, LineArray, Shading, tabulate_pattern

Array = NDArray[np.float64]

NEAR = 1.0
"""Differences of cosines up to which a target's pattern is fitted."""


@dataclass(frozen=True)
class Patterns:
    """Beam patterns of spectra that are mixtures of a flat one and of tones; each pattern's peak is 1.

    Attributes:
        array: The receiver.
        band: Its frequencies.
        shading: Of its elements.
        tones: Tones of the mixture, equally spaced over the band.
        points: Of a table from 0 to 2 in the difference of cosines.
    """

    array: LineArray
    band: Band
    shading: Shading = "conventional"
    tones: int = 28
    points: int = 4001

    @cached_property
    def tables(self) -> Array:
        """Patterns of the flat spectrum and of each tone, shape (1 + tones, points)."""
        f = self.band.frequencies
        spectra = [np.ones(len(f))]
        for at in np.unique(np.linspace(0, len(f) - 1, self.tones).astype(int)):
            spectra.append(np.where(np.arange(len(f)) == at, 1.0, 0.0))
        tables = np.array([tabulate_pattern(self.array, f, s, self.shading, self.points).values for s in spectra])
        return tables / tables[:, :1]

    @cached_property
    def flat(self) -> Array:
        """The mixture that is the flat spectrum alone."""
        mixture = np.zeros(len(self.tables))
        mixture[0] = 1.0
        return mixture

    def at(self, mixture: Array, cosine_looks: Array, bearings_deg: Array) -> Array:
        """Pattern of one mixture for a source at each bearing. Shape (T, beams)."""
        values = mixture @ self.tables
        offset = np.abs(np.cos(np.radians(bearings_deg))[:, None] - cosine_looks)
        position = offset * ((self.points - 1) / 2.0)
        below = position.astype(np.int64)
        np.minimum(below, self.points - 2, out=below)
        low = values[below]
        return low + (position - below) * (values[below + 1] - low)

    def main_lobe(self, mixture: Array) -> Array:
        """Pattern of a mixture near its peak, a few points."""
        return np.interp(np.linspace(0.0, 0.125, 26), np.linspace(0.0, 2.0, self.points), mixture @ self.tables)

    def fit(self, excess: Array, variance: Array, cosine_looks: Array, bearings_deg: Array, power: Array) -> Array:
        """Mixture that explains the excess around a source best, with a prior for the flat spectrum.

        Args:
            excess: Beam powers above what others explain. Shape (T, beams).
            variance: Of the excess. Shape (T, beams).
            cosine_looks: Shape (beams,).
            bearings_deg: Of the source in each row. Shape (T,).
            power: Of the source in each row, positive. Shape (T,).

        Returns:
            Not negative, sum 1. Shape (1 + tones,).
        """
        offset = np.abs(np.cos(np.radians(bearings_deg))[:, None] - cosine_looks)
        near = offset < NEAR
        bins = 640
        index = (offset[near] * (bins / NEAR)).astype(int)
        weight = (power[:, None] ** 2 / variance)[near]
        total = np.bincount(index, weight, bins)
        mean = np.bincount(index, weight * (excess / power[:, None])[near], bins) / np.maximum(total, 1e-12)
        centers = np.bincount(index, weight * offset[near], bins) / np.maximum(total, 1e-12)
        position = centers * ((self.points - 1) / 2.0)
        below = np.minimum(position.astype(np.int64), self.points - 2)
        low = self.tables[:, below]
        design = (low + (position - below) * (self.tables[:, below + 1] - low)).T
        # Neighboring beams share their noise: some ten of them count as one.
        root = np.sqrt(total / 10.0)
        prior = 3.0
        rows = np.vstack([design * root[:, None], prior * np.eye(len(self.tables))])
        mixture, _ = nnls(rows, np.concatenate([mean * root, prior * self.flat]))
        return mixture / mixture.sum() if mixture.sum() > 0.0 else self.flat


def variance_of(explained: Array, averages: int, error: float, reach: int) -> Array:
    """Variance of beam powers about what is explained, noise and model error.

    Args:
        explained: Mean beam powers, noise 1. Shape (T, beams).
        averages: M of one beam power.
        error: Relative standard deviation of what targets explain.
        reach: Beams over which a pattern may be misplaced: the error is of the largest value in reach.

    Returns:
        Shape (T, beams).
    """
    skirts = maximum_filter1d(explained - 1.0, 2 * reach + 1, axis=1)
    return explained**2 / averages + (error * skirts) ** 2


def fit_powers(rows: Array, patterns: Array, variance: Array, expected: Array, spread: Array) -> Array:
    """Powers of all targets in each row by weighted least squares, with a prior.

    Args:
        rows: Normalized beam powers. Shape (T, beams).
        patterns: Of each target, 0 where it is absent. Shape (L, T, beams).
        variance: Of the beam powers. Shape (T, beams).
        expected: Prior mean of the powers. Shape (L, T).
        spread: Prior standard deviation. Shape (L, T).

    Returns:
        Not negative. Shape (L, T).
    """
    weight = 0.1 / variance
    by_row = np.ascontiguousarray(patterns.transpose(1, 0, 2))
    normal = (by_row * weight[:, None]) @ by_row.transpose(0, 2, 1)
    right = (by_row @ ((rows - 1.0) * weight)[:, :, None])[:, :, 0]
    precision = (1.0 / spread**2).T
    index = np.arange(len(patterns))
    normal[:, index, index] += precision
    right += precision * expected.T
    return np.maximum(np.linalg.solve(normal, right[:, :, None])[:, :, 0].T, 0.0)
