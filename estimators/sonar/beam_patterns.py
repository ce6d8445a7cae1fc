"""Beam patterns of target spectra, least-squares fits of powers, and the variance of beam powers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.array import Band, LineArray, Shading, tabulate_pattern
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Patterns:
    """Beam patterns of spectra that are mixtures of a flat one and of tones; each pattern's peak is 1.

    Attributes:
        array: Line array of the receiver.
        band: Frequency bins of the receiver.
        shading: Shading of the elements.
        tones: Number of tones of the mixture, equally spaced over the band. Larger values resolve spectra better and
            are slower.
        points: Number of points of a table from 0 to 2 in the difference of cosines.
        fit_range: Difference of cosines up to which a target's pattern is fitted.
        bins: Number of bins of the differences up to `fit_range`.
        shared_beams: Number of neighboring beams that share their noise and count as one measurement.
        flat_weight: Weight of the flat spectrum as prior. Larger values need more data for a colored spectrum.
    """

    array: LineArray
    band: Band
    shading: Shading = "conventional"
    tones: int = 28
    points: int = 4001
    fit_range: float = 1.0
    bins: int = 640
    shared_beams: float = 10.0
    flat_weight: float = 3.0

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
        """Mixture of the flat spectrum alone. Shape (1 + tones,)."""
        mixture = np.zeros(len(self.tables))
        mixture[0] = 1.0
        return mixture

    def at(self, mixture: Array, beam_cosines: Array, bearings_deg: Array) -> Array:
        """Pattern of one mixture for a source at each bearing. Shape (T, beams).

        Args:
            mixture: Mixture of spectra. Shape (1 + tones,).
            beam_cosines: Cosines of the beams' bearings. Shape (beams,).
            bearings_deg: Bearings of the source, deg. Shape (T,).
        """
        out = np.empty((len(bearings_deg), len(beam_cosines)))
        _interpolate(mixture @ self.tables, np.cos(np.radians(bearings_deg)), beam_cosines, out)
        return out

    def main_lobe(self, mixture: Array) -> Array:
        """Pattern of a mixture near its peak, at 26 points."""
        return np.interp(np.linspace(0.0, 0.125, 26), np.linspace(0.0, 2.0, self.points), mixture @ self.tables)

    def fit(self, excess: Array, variance: Array, beam_cosines: Array, bearings_deg: Array, power: Array) -> Array:
        """Fit the mixture of spectra to the beam powers around a source, with a prior for the flat spectrum.

        Args:
            excess: Beam powers above those explained by noise and other targets. Shape (T, beams).
            variance: Variance of the excess. Shape (T, beams).
            beam_cosines: Cosines of the beams' bearings. Shape (beams,).
            bearings_deg: Bearing of the source in each row, deg. Shape (T,).
            power: Power of the source in each row, positive. Shape (T,).

        Returns:
            Mixture weights, not negative, with sum 1. Shape (1 + tones,).
        """
        sums = np.zeros((3, self.bins))
        scale = self.bins / self.fit_range
        _bin(excess, variance, np.cos(np.radians(bearings_deg)), beam_cosines, power, self.fit_range, scale, sums)
        some = sums[0] > 0.0
        total, mean, centers = sums[0, some], sums[1, some] / sums[0, some], sums[2, some] / sums[0, some]
        position = centers * ((self.points - 1) / 2.0)
        below = np.minimum(position.astype(np.int64), self.points - 2)
        low = self.tables[:, below]
        design = low + (position - below) * (self.tables[:, below + 1] - low)
        # Normal equations have one row per spectrum instead of one per bin.
        weighted = design * (total / self.shared_beams)
        normal = weighted @ design.T
        normal[np.diag_indices_from(normal)] += self.flat_weight**2
        root = np.linalg.cholesky(normal)
        mixture, _ = nnls(root.T, solve_triangular(root, weighted @ mean + self.flat_weight**2 * self.flat, lower=True))
        return mixture / mixture.sum() if mixture.sum() > 0.0 else self.flat


def variance_of(explained: Array, averages: int, error: float, reach: int) -> Array:
    """Variance of beam powers about the explained means, by noise and model error.

    Args:
        explained: Mean beam powers, noise 1. Shape (T, beams).
        averages: Number M of averages in one beam power. Larger values mean less noise.
        error: Relative standard deviation of the power explained by targets.
        reach: Number of beams by which a pattern may be misplaced: the error scales with the largest value in reach.

    Returns:
        Variances. Shape (T, beams).
    """
    out = np.empty_like(explained)
    _variance(explained, averages, error, reach, out)
    return out


class PowerFit(NamedTuple):
    """Normal equations of the powers of all targets in each row.

    Attributes:
        normal: Normal matrices of L targets. Shape (T, L, L).
        right: Right-hand sides. Shape (T, L).
    """

    normal: Array
    right: Array

    @classmethod
    def of(cls, excess: Array, patterns: Array, presence: Array, variance: Array, shared_beams: float) -> PowerFit:
        """Set up the weighted least squares.

        Args:
            excess: Normalized beam powers above noise and all other targets. Shape (T, beams).
            patterns: Beam pattern of each target. Shape (L, T, beams).
            presence: Probability that the target exists. Shape (L, T).
            variance: Variance of the beam powers. Shape (T, beams).
            shared_beams: Number of neighboring beams that share their noise.
        """
        L, T = presence.shape
        fit = cls(np.empty((T, L, L)), np.empty((T, L)))
        _normal_equations(excess, patterns, presence, shared_beams * variance, fit.normal, fit.right)
        return fit

    def powers(self, expected: Array, spread: Array) -> Array:
        """Solve for the powers under a Gaussian prior.

        Args:
            expected: Prior mean. Shape (L, T).
            spread: Prior standard deviation. Shape (L, T).

        Returns:
            Powers, not negative. Shape (L, T).
        """
        precision = (1.0 / spread**2).T
        normal, index = self.normal.copy(), np.arange(len(expected))
        normal[:, index, index] += precision
        right = self.right + precision * expected.T
        return np.maximum(np.linalg.solve(normal, right[:, :, None])[:, :, 0].T, 0.0)


@njit(cache=True, nogil=True)
def add_pattern(mean, power, pattern):  # type: ignore[no-untyped-def]
    """Add a target's power in each row, shape (T,), times its pattern to the mean, shape (T, beams)."""
    for k in range(mean.shape[0]):
        if power[k] != 0.0:
            row, shape, factor = mean[k], pattern[k], power[k]
            for i in range(mean.shape[1]):
                row[i] += factor * shape[i]


@njit(cache=True, nogil=True)
def _interpolate(table, cosines, beam_cosines, out):  # type: ignore[no-untyped-def]
    """Interpolate a table over differences of cosines from 0 to 2, for a source at each cosine."""
    last = table.shape[0] - 1
    scale = last / 2.0
    for k in range(out.shape[0]):
        for i in range(out.shape[1]):
            position = abs(cosines[k] - beam_cosines[i]) * scale
            below = min(int(position), last - 1)
            out[k, i] = table[below] + (position - below) * (table[below + 1] - table[below])


@njit(cache=True, nogil=True)
def _bin(excess, variance, cosines, beam_cosines, power, fit_range, scale, sums):  # type: ignore[no-untyped-def]
    """Sum weights, weighted excess over power, and weighted differences of cosines, in bins of these differences."""
    for k in range(excess.shape[0]):
        for i in range(excess.shape[1]):
            offset = abs(cosines[k] - beam_cosines[i])
            if offset < fit_range:
                weight = power[k] / variance[k, i]
                at = int(offset * scale)
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
    """Write the largest of the values within `reach` indices of each to `out`."""
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
