"""Beam patterns of target spectra, least-squares fits of powers, and the variance of beam powers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.array import Band, LineArray, Shading, tabulate_pattern
from servotrack.estimators.sonar.beamforming import Beamformer
from servotrack.estimators.sonar.elements import AnyArray, ElementArray, phases
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Patterns:
    """Beam patterns of spectra that are mixtures of a flat one and of tones; each pattern's peak is 1.

    Attributes:
        array: Line array of the receiver.
        band: Frequency bins of the receiver.
        shading: Shading of the elements.
        beamformer: Beamformer of the rows. A spectrum's pattern is that of a conventional beamformer, or of MVDR for a
            flat spectrum at several powers of the source.
        tones: Number of tones of the mixture, equally spaced over the band. Larger values resolve spectra better and
            are slower.
        points: Number of points of a table from 0 to 2 in the difference of cosines.
        fit_range: Difference of cosines up to which a target's pattern is fitted.
        bins: Number of bins of the differences up to `fit_range`.
        shared_beams: Number of neighboring beams that share their noise and count as one measurement.
        flat_weight: Weight of the flat spectrum as prior. Larger values need more data for a colored spectrum.
    """

    array: AnyArray
    band: Band
    shading: Shading = "conventional"
    beamformer: Beamformer = "conventional"
    tones: int = 28
    points: int = 4001
    fit_range: float = 1.0
    bins: int = 640
    shared_beams: float = 10.0
    flat_weight: float = 3.0

    @cached_property
    def tables(self) -> Array:
        """Patterns of the flat spectrum and of each tone, or of each power for MVDR, shape (spectra, points)."""
        f = self.band.frequencies
        if isinstance(self.array, ElementArray) or self.beamformer == "mvdr":
            offset = np.linspace(0.0, 2.0, self.points)
            return _spectra((line_pattern(self.array, one, offset) for one in f), len(f), self.beamformer, self.tones)
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

    @cached_property
    def width(self) -> float:
        """Width of a beam across the array at half its power, for a flat spectrum, deg."""
        return self._width(self.tables[0])

    @cached_property
    def widths(self) -> tuple[float, float]:
        """Smallest and largest width of a beam across the array at half its power, over all spectra, deg."""
        every = [self._width(table) for table in self.tables]
        return min(every), max(every)

    def _width(self, table: Array) -> float:
        half = 2.0 / (len(table) - 1) * int((table < 0.5).argmax())
        return 2.0 * math.degrees(math.asin(min(half, 1.0))) if half > 0.0 else 180.0

    def at(self, mixture: Array, beam_bearings: Array, bearings_deg: Array) -> Array:
        """Pattern of one mixture for a source at each bearing. Shape (T, beams).

        Args:
            mixture: Mixture of spectra. Shape (1 + tones,).
            beam_bearings: Bearings of the beams, deg. Shape (beams,).
            bearings_deg: Bearings of the source, deg. Shape (T,).
        """
        out = np.empty((len(bearings_deg), len(beam_bearings)))
        table, beam_cosines = mixture @ self.tables, np.cos(np.radians(beam_bearings))
        _interpolate(table, np.cos(np.radians(bearings_deg)), beam_cosines, out)
        return out

    def main_lobe(self, mixture: Array) -> Array:
        """Pattern of a mixture near its peak, at 26 points."""
        return np.interp(np.linspace(0.0, 0.125, 26), np.linspace(0.0, 2.0, self.points), mixture @ self.tables)

    def fit(self, excess: Array, variance: Array, beam_bearings: Array, bearings_deg: Array, power: Array) -> Array:
        """Fit the mixture of spectra to the beam powers around a source, with a prior for the flat spectrum.

        Args:
            excess: Beam powers above those explained by noise and other targets. Shape (T, beams).
            variance: Variance of the excess. Shape (T, beams).
            beam_bearings: Bearings of the beams, deg. Shape (beams,).
            bearings_deg: Bearing of the source in each row, deg. Shape (T,).
            power: Power of the source in each row, positive. Shape (T,).

        Returns:
            Mixture weights, not negative, with sum 1. Shape (1 + tones,).
        """
        sums = np.zeros((3, self.bins))
        scale, beam_cosines = self.bins / self.fit_range, np.cos(np.radians(beam_bearings))
        _bin(excess, variance, np.cos(np.radians(bearings_deg)), beam_cosines, power, self.fit_range, scale, sums)
        some = sums[0] > 0.0
        total, mean, centers = sums[0, some], sums[1, some] / sums[0, some], sums[2, some] / sums[0, some]
        position = centers * ((self.points - 1) / 2.0)
        below = np.minimum(position.astype(np.int64), self.points - 2)
        low = self.tables[:, below]
        design = low + (position - below) * (self.tables[:, below + 1] - low)
        # Normal equations have one row per spectrum instead of one per bin.
        weighted = design * (total / self.shared_beams)
        return solve_mixture(weighted @ design.T, weighted @ mean, self.flat, self.flat_weight)


def solve_mixture(normal: Array, right: Array, flat: Array, weight: float) -> Array:
    """Solve the normal equations of a mixture of spectra, not negative and with sum 1, with a prior for `flat`."""
    normal[np.diag_indices_from(normal)] += weight**2
    root = np.linalg.cholesky(normal)
    mixture, _ = nnls(root.T, solve_triangular(root, right + weight**2 * flat, lower=True))
    return mixture / mixture.sum() if mixture.sum() > 0.0 else flat


def line_pattern(array: AnyArray, frequency: float, offset: Array) -> Array:
    """Beam pattern of a line of elements at one frequency over the difference of cosines, peak 1. Shape of offset."""
    if isinstance(array, LineArray):
        return tabulate_pattern(array, [frequency], [1.0], points=len(offset)).values / array.elements
    place = array.delays([0.0])[0]
    wave = np.exp(2j * np.pi * frequency * offset[:, None] * place)
    return np.asarray(np.abs(wave.mean(axis=1)) ** 2)


def _spectra(patterns: Iterable[Array], count: int, beamformer: str, tones: int) -> Array:
    """Patterns of spectra, peak 1, from the patterns of single bins. Shape (spectra, *points).

    The conventional spectra are a flat one and tones. With MVDR and the exact covariance, a source of power b / (1 - b)
    over the noise of a conventional beam adds b D / (1 - b D) to a beam in whose direction the pattern is D.
    """
    if beamformer == "mvdr":
        total, shares = None, (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.995)
        for pattern in patterns:
            shapes = np.array([(1.0 - b) * pattern / (1.0 - b * pattern) for b in shares])
            total = shapes if total is None else total + shapes
        assert total is not None
        return np.asarray(total / count)
    at = np.unique(np.linspace(0, count - 1, tones).astype(int)).tolist()
    flat, kept = None, []
    for index, pattern in enumerate(patterns):
        flat = pattern.copy() if flat is None else flat + pattern
        if index in at:
            kept.append(pattern)
    assert flat is not None
    return np.array([flat / count, *kept])


@dataclass(frozen=True)
class PlanarPatterns:
    """Beam patterns of a planar array, which depend on both bearings; otherwise as `Patterns`.

    Attributes:
        array: Elements of the receiver.
        band: Frequency bins of the receiver.
        beamformer: Beamformer of the rows.
        beams: Bearings of the beams, deg.
        sources: Number of bearings of sources over the circle that are tabulated.
        tones: Number of tones of the mixture.
        bins: Largest number of frequency bins that stand for the band.
        fit_rows: Largest number of rows to which a spectrum is fitted.
        shared_beams: Number of neighboring beams that share their noise and count as one measurement.
        flat_weight: Weight of the flat spectrum as prior.
    """

    array: AnyArray
    band: Band
    beamformer: Beamformer
    beams: tuple[float, ...]
    sources: int = 360
    tones: int = 12
    bins: int = 32
    fit_rows: int = 20
    shared_beams: float = 10.0
    flat_weight: float = 3.0

    @cached_property
    def tables(self) -> Array:
        """Patterns for sources around the circle, the first one repeated. Shape (spectra, sources + 1, beams)."""
        f = self.band.frequencies
        f = f[np.unique(np.linspace(0, len(f) - 1, min(self.bins, len(f))).astype(int))]
        places = np.linspace(0.0, 360.0, self.sources + 1)

        def pattern(frequency: float) -> Array:
            sources, beams = (phases(self.array, [frequency], some)[0] for some in (places, self.beams))
            return np.asarray(np.abs(sources @ beams.conj().T / self.array.elements) ** 2)

        return _spectra((pattern(one) for one in f.tolist()), len(f), self.beamformer, self.tones)

    @cached_property
    def flat(self) -> Array:
        """Mixture of the flat spectrum alone. Shape (spectra,)."""
        mixture = np.zeros(len(self.tables))
        mixture[0] = 1.0
        return mixture

    @cached_property
    def width(self) -> float:
        """Median width of a beam at half its power, for a flat spectrum, deg."""
        return self._width(self.band.frequencies)

    @cached_property
    def widths(self) -> tuple[float, float]:
        """Width of a beam at half its power at the highest and at the lowest frequency, deg."""
        return self._width(self.band.frequencies[-1:]), self._width(self.band.frequencies[:1])

    def _width(self, frequencies: Array) -> float:
        f = frequencies[np.unique(np.linspace(0, len(frequencies) - 1, 8).astype(int))]
        fine = np.linspace(-90.0, 90.0, 1801)
        found = []
        for place in np.arange(0.0, 360.0, 15.0):
            waves, beams = phases(self.array, f, [place])[:, 0], phases(self.array, f, place + fine)
            shape = (np.abs(np.einsum("fn,fbn->fb", waves, beams.conj())) ** 2).mean(axis=0)
            below = shape < 0.5 * shape[900]
            after, before = int(below[900:].argmax()), int(below[900::-1].argmax())
            found.append(0.1 * (after + before) if after and before else 180.0)
        return float(np.median(found))

    def at(self, mixture: Array, beam_bearings: Array, bearings_deg: Array) -> Array:
        """Pattern of one mixture for a source at each bearing; `beam_bearings` are those of the table. (T, beams)."""
        table = np.tensordot(mixture, self.tables, 1)
        position = np.mod(bearings_deg, 360.0) / 360.0 * self.sources
        below = np.minimum(position.astype(np.int64), self.sources - 1)
        part = (position - below)[:, None]
        return np.asarray((1.0 - part) * table[below] + part * table[below + 1])

    def main_lobe(self, mixture: Array) -> Array:
        """Pattern of a mixture from its peak to two widths beside it, at 26 points, for a source at 90 deg."""
        row = self.at(mixture, np.zeros(0), np.array([90.0]))[0]
        beside = np.linspace(0.0, 2.0 * self.width, 26) + 90.0
        return np.interp(beside, self.beams, row, period=360.0)

    def fit(self, excess: Array, variance: Array, beam_bearings: Array, bearings_deg: Array, power: Array) -> Array:
        """Fit the mixture of spectra to the beam powers around a source; arguments and result as in `Patterns`."""
        some = np.unique(np.linspace(0, len(excess) - 1, min(self.fit_rows, len(excess))).astype(int))
        eye = np.eye(len(self.tables))
        design = np.array([self.at(one, beam_bearings, bearings_deg[some]) for one in eye])
        weight = power[some, None] ** 2 / variance[some] / self.shared_beams
        weighted = (design * weight).reshape(len(eye), -1)
        right = weighted @ (excess[some] / power[some, None]).reshape(-1)
        return solve_mixture(weighted @ design.reshape(len(eye), -1).T, right, self.flat, self.flat_weight)


def variance_of(explained: Array, averages: float, error: float, reach: int) -> Array:
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
