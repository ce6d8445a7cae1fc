"""What targets explain of a record: their spectra as beam patterns, their powers, and how far both can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from servotrack.estimators.sonar.array import Band, LineArray, Shading, tabulate_pattern
from servotrack.estimators.types import Array

NEAR = 1.0
"""Differences of cosines up to which a target's pattern is fitted."""
BINS = 640
"""Of these differences."""
SHARED = 10.0
"""Neighboring beams share their noise: so many of them count as one."""
PRIOR = 3.0
"""Weight of the flat spectrum beside the data's."""


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
        out = np.empty((len(bearings_deg), len(cosine_looks)))
        _interpolate(mixture @ self.tables, np.cos(np.radians(bearings_deg)), cosine_looks, out)
        return out

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
        sums = np.zeros((3, BINS))
        _bin(excess, variance, np.cos(np.radians(bearings_deg)), cosine_looks, power, sums)
        some = sums[0] > 0.0
        total, mean, centers = sums[0, some], sums[1, some] / sums[0, some], sums[2, some] / sums[0, some]
        position = centers * ((self.points - 1) / 2.0)
        below = np.minimum(position.astype(np.int64), self.points - 2)
        low = self.tables[:, below]
        design = low + (position - below) * (self.tables[:, below + 1] - low)
        # Least squares by normal equations: as many rows as spectra instead of as many as bins.
        weighted = design * (total / SHARED)
        normal = weighted @ design.T
        normal[np.diag_indices_from(normal)] += PRIOR**2
        root = np.linalg.cholesky(normal)
        mixture, _ = nnls(root.T, solve_triangular(root, weighted @ mean + PRIOR**2 * self.flat, lower=True))
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
    out = np.empty_like(explained)
    _variance(explained, averages, error, reach, out)
    return out


class PowerFit(NamedTuple):
    """Normal equations of the powers of all targets in each row.

    Attributes:
        normal: Shape (T, L, L).
        right: Shape (T, L).
    """

    normal: Array
    right: Array

    @classmethod
    def of(cls, excess: Array, patterns: Array, presence: Array, variance: Array) -> PowerFit:
        """Weighted least squares.

        Args:
            excess: Normalized beam powers above noise and all other targets. Shape (T, beams).
            patterns: Of each target. Shape (L, T, beams).
            presence: Probability that the target is there. Shape (L, T).
            variance: Of the beam powers. Shape (T, beams).
        """
        L, T = presence.shape
        fit = cls(np.empty((T, L, L)), np.empty((T, L)))
        _normal_equations(excess, patterns, presence, SHARED * variance, fit.normal, fit.right)
        return fit

    def powers(self, expected: Array, spread: Array) -> Array:
        """Powers, with a prior.

        Args:
            expected: Prior mean. Shape (L, T).
            spread: Prior standard deviation. Shape (L, T).

        Returns:
            Not negative. Shape (L, T).
        """
        precision = (1.0 / spread**2).T
        normal, index = self.normal.copy(), np.arange(len(expected))
        normal[:, index, index] += precision
        right = self.right + precision * expected.T
        return np.maximum(np.linalg.solve(normal, right[:, :, None])[:, :, 0].T, 0.0)


@njit(cache=True, nogil=True)
def add_pattern(mean, power, pattern):  # type: ignore[no-untyped-def]
    """A target's power in each row, shape (T,), times its pattern is added to the mean, shape (T, beams)."""
    for k in range(mean.shape[0]):
        if power[k] != 0.0:
            row, shape, factor = mean[k], pattern[k], power[k]
            for i in range(mean.shape[1]):
                row[i] += factor * shape[i]


@njit(cache=True, nogil=True)
def _interpolate(table, cosines, cosine_looks, out):  # type: ignore[no-untyped-def]
    """The table, of differences of cosines from 0 to 2, about each cosine."""
    last = table.shape[0] - 1
    scale = last / 2.0
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            position = abs(cosines[k] - cosine_looks[i]) * scale
            below = min(int(position), last - 1)
            out[k, i] = table[below] + (position - below) * (table[below + 1] - table[below])


@njit(cache=True, nogil=True)
def _bin(excess, variance, cosines, cosine_looks, power, sums):  # type: ignore[no-untyped-def]
    """Sums of weights, of weighted excess over power, and of weighted differences of cosines, in bins of these."""
    for k in range(excess.shape[0]):
        for i in range(excess.shape[1]):
            offset = abs(cosines[k] - cosine_looks[i])
            if offset < NEAR:
                weight = power[k] / variance[k, i]
                at = int(offset * (BINS / NEAR))
                sums[0, at] += weight * power[k]
                sums[1, at] += weight * excess[k, i]
                sums[2, at] += weight * power[k] * offset


@njit(cache=True, nogil=True)
def _variance(explained, averages, error, reach, out):  # type: ignore[no-untyped-def]
    """See `variance_of`."""
    beams = explained.shape[1]
    skirts = np.empty(beams)
    for k in range(explained.shape[0]):
        row = explained[k]
        largest_near(row, reach, skirts)
        for i in range(beams):
            out[k, i] = row[i] * row[i] / averages + (error * (skirts[i] - 1.0)) ** 2


@njit(cache=True, nogil=True)
def largest_near(values, reach, out):  # type: ignore[no-untyped-def]
    """Largest of the values within `reach` of each."""
    count = values.shape[0]
    out[:] = values
    for shift in range(1, min(reach, count - 1) + 1):
        left, right, low, high = values[: count - shift], values[shift:], out[shift:], out[: count - shift]
        for i in range(count - shift):
            low[i] = left[i] if left[i] > low[i] else low[i]
        for i in range(count - shift):
            high[i] = right[i] if right[i] > high[i] else high[i]


@njit(cache=True, nogil=True, fastmath=True)
def _normal_equations(excess, patterns, presence, variance, normal, right):  # type: ignore[no-untyped-def]
    """See `PowerFit.of`."""
    count, length, beams = patterns.shape
    weighted = np.empty(beams)
    for k in range(length):
        row, spread = excess[k], variance[k]
        for a in range(count):
            one, there = patterns[a, k], presence[a, k]
            total = 0.0
            for i in range(beams):
                weighted[i] = there * one[i] / spread[i]
                total += weighted[i] * row[i]
            right[k, a] = total
            for b in range(a + 1):
                other = patterns[b, k]
                total = 0.0
                for i in range(beams):
                    total += weighted[i] * other[i]
                normal[k, a, b] = normal[k, b, a] = presence[b, k] * total
