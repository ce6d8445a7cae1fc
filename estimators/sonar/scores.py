"""Matched filter over a whole row: power of a source at each bearing, and its variance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.beam_patterns import Patterns, PlanarPatterns, largest_near
from servotrack.estimators.sonar.beamforming import noise_correlation
from servotrack.estimators.types import Array, Labels, Mask


class Template(NamedTuple):
    """Whitened pattern of a source at each beam bearing.

    Attributes:
        values: Pattern in the beams from `reach` below a bearing to `reach` above. Shape (beams, 2 reach + 1).
        inflation: Variance of a matched sum over the beams, relative to independent beams. Shape (beams,).
    """

    values: Array
    inflation: Array


@dataclass(frozen=True, eq=False)
class RowScores:
    """Matched filter over a whole row, whose neighboring beams share their noise.

    Attributes:
        patterns: Beam patterns of sources.
        beam_bearings: Bearings of the beams, deg. Shape (beams,).
        grid_bearings: Bearings at which the power is evaluated, deg; None: those of the beams. Shape (positions,).
        circle: The beams close after 360 deg.
        averages: Number M of averages in one beam power.
        model_error: Relative standard deviation of the power explained by targets. Larger values trust beams near
            other targets less.
        misplaced: Number of beams by which a pattern may be misplaced.
        reach: Number of beams of the matched filter to each side. Larger values use more of the pattern and are slower.
        damping: Constant added to the eigenvalues of the noise correlation in whitening. Larger values whiten less.
    """

    patterns: Patterns | PlanarPatterns
    beam_bearings: Array
    averages: float
    model_error: float = 0.15
    misplaced: int = 4
    reach: int = 24
    damping: float = 1.0
    grid_bearings: Array | None = None
    circle: bool = False

    @cached_property
    def _correlation(self) -> Array:
        p = self.patterns
        shading = p.shading if isinstance(p, Patterns) else "conventional"
        return noise_correlation(p.array, p.band.frequencies, self.beam_bearings, shading)

    @property
    def _grid(self) -> Array:
        return self.beam_bearings if self.grid_bearings is None else self.grid_bearings

    @property
    def _apart(self) -> bool:
        """True if a position's beams are not the neighbors of the beam with its index."""
        return self.circle or self.grid_bearings is not None

    def _around(self, center: Labels) -> tuple[Labels, Mask]:
        index, beams = center[:, None] + np.arange(-self.reach, self.reach + 1), len(self.beam_bearings)
        if self.circle:
            return index % beams, np.ones(index.shape, np.bool_)
        return np.clip(index, 0, beams - 1), (index >= 0) & (index < beams)

    @cached_property
    def _neighbors(self) -> tuple[Labels, Mask]:
        return self._around(np.arange(len(self.beam_bearings)))

    @cached_property
    def _beside(self) -> tuple[Labels, Mask]:
        """Beams about each position of the grid, and whether they exist. Shape (positions, 2 reach + 1) each."""
        if self.grid_bearings is None:
            return self._neighbors
        away = self.grid_bearings[:, None] - self.beam_bearings
        away = (away + 180.0) % 360.0 - 180.0 if self.circle else away
        return self._around(np.abs(away).argmin(axis=1))

    @cached_property
    def whitening(self) -> Array:
        """Filter that makes the noise of neighboring beams nearly independent. Shape (beams, 2 reach + 1)."""
        values, vectors = np.linalg.eigh(self._correlation)
        whole = (vectors / np.sqrt(np.maximum(values, 0.0) + self.damping)) @ vectors.T
        index, inside = self._neighbors
        return np.ascontiguousarray(np.where(inside, np.take_along_axis(whole, index, 1), 0.0))

    @cached_property
    def _noise(self) -> tuple[Array, Array, Labels]:
        """Variances of whitened noise, its covariance blocks (some, width, width) at some beams, and their indices."""
        index, inside = self._neighbors
        square = np.zeros_like(self._correlation)
        rows = np.broadcast_to(np.arange(len(self.beam_bearings))[:, None], index.shape)
        square[rows[inside], index[inside]] = self.whitening[inside]
        covariance = square @ self._correlation @ square.T
        beside, _ = self._beside
        some = np.unique(np.linspace(0, len(beside) - 1, 31).astype(int))
        blocks = np.array([covariance[np.ix_(beside[i], beside[i])] for i in some])
        return np.ascontiguousarray(np.diag(covariance)), blocks, some

    @cached_property
    def _basis(self) -> Array:
        """Whitened pattern of each pure spectrum at every beam bearing. Shape (1 + tones, beams * (2 reach + 1))."""
        index, inside = self._beside
        whitened = (
            self.whiten(self.patterns.at(mixture, self.beam_bearings, self._grid))
            for mixture in np.eye(len(self.patterns.tables))
        )
        return np.array([np.where(inside, np.take_along_axis(p, index, 1), 0.0).ravel() for p in whitened])

    def whiten(self, rows: Array) -> Array:
        """Filter rows so that the noise of neighboring beams is nearly independent.

        Args:
            rows: Beam powers, or their explained means. Shape (T, beams).

        Returns:
            Whitened rows. Shape (T, beams).
        """
        out = np.empty_like(rows)
        if self.circle:
            # The filter about the first beams reaches to the last ones.
            wide = np.pad(rows, ((0, 0), (self.reach, self.reach)), mode="wrap")
            _filter_within(np.ascontiguousarray(wide), self._columns, out)
        else:
            _filter(np.ascontiguousarray(rows), self._columns, out)
        return out

    @cached_property
    def _columns(self) -> Array:
        return np.ascontiguousarray(self.whitening.T)

    def template(self, mixture: Array) -> Template:
        """Compute the whitened pattern of a mixture of spectra."""
        index, inside = self._beside
        used = np.flatnonzero(mixture > 1e-3)
        values = np.zeros(index.shape)
        _mix(self._basis, used, mixture, values.reshape(-1))
        # The inflation by correlated beams changes slowly with bearing, so it is interpolated.
        power, blocks, some = self._noise
        few = values[some]
        noise = np.einsum("ij,ijk,ik->i", few, blocks, few)
        inflation = noise / np.einsum("ij,ij->i", few**2, power[index[some]] * inside[some])
        return Template(values, np.interp(np.arange(len(index)), some, inflation))

    def evaluate(self, whitened: Array, explained: Array, template: Template) -> tuple[Array, Array]:
        """Power of a source at each bearing and the variance of that power, under noise and the model's errors.

        Args:
            whitened: Normalized beam powers less 1, after `whiten`. Shape (T, beams).
            explained: Mean beam powers by noise and all other targets, noise 1. Shape (T, beams).
            template: Whitened pattern of the source.

        Returns:
            Power and variance. Shape (T, beams) each.
        """
        others = self.whiten(explained - 1.0)
        noise = self._noise[0] / self.averages
        power, variance = np.empty((2, len(whitened), len(self._grid)))
        if self._apart:
            _match_beside(
                whitened, explained, others, noise, self.model_error, self.misplaced, template.values,
                self._beside[0], template.inflation, power, variance,
            )  # fmt: skip
        else:
            _match(
                whitened, explained, others, noise, self.model_error, self.misplaced, *self._columns_of(template),
                power, variance,
            )  # fmt: skip
        # The spread over all bearings corrects the variance for noise that deviates from the model.
        scores = np.abs(power) / np.sqrt(variance)
        spread = np.median(scores, axis=1, keepdims=True) / 0.6745
        return power, variance * np.maximum(spread, 1.0) ** 2

    def _columns_of(self, template: Template) -> tuple[Array, Array]:
        return np.ascontiguousarray(template.values.T), template.inflation


@njit(cache=True, nogil=True)
def _mix(basis, used, mixture, out):  # type: ignore[no-untyped-def]
    """Add the used rows of a basis, weighted by the mixture, to `out`."""
    for i in used:
        row, share = basis[i], mixture[i]
        for j in range(out.shape[0]):
            out[j] += share * row[j]


@njit(cache=True, nogil=True, fastmath=True)
def _match(whitened, explained, others, noise, error, misplaced, template, inflation, power, variance):  # type: ignore[no-untyped-def]
    """Least-squares power of the template at every beam, and its variance; template (width, beams)."""
    width, beams = template.shape
    reach = width // 2
    # Zero padding beyond the first and the last beam.
    weighted, precision = np.zeros(beams + width - 1), np.zeros(beams + width - 1)
    skirts, largest = np.empty(beams), np.empty(beams)
    squares = template * template
    inside, trust = weighted[reach : reach + beams], precision[reach : reach + beams]
    for k in range(whitened.shape[0]):
        row, mean, other = whitened[k], explained[k], others[k]
        for i in range(beams):
            skirts[i] = abs(other[i])
        largest_near(skirts, misplaced, largest)
        for i in range(beams):
            trust[i] = 1.0 / (noise[i] * mean[i] * mean[i] + error * error * largest[i] * largest[i])
        for i in range(beams):
            inside[i] = trust[i] * (row[i] - other[i])
        total, information = power[k], variance[k]
        _correlate(template, weighted, total)
        _correlate(squares, precision, information)
        for i in range(beams):
            information[i] = 1.0 / information[i]
        for i in range(beams):
            total[i] *= information[i]
        for i in range(beams):
            information[i] *= inflation[i]


@njit(cache=True, nogil=True)
def _match_beside(whitened, explained, others, noise, error, misplaced, template, beside, inflation, power, variance):  # type: ignore[no-untyped-def]
    """Compute `_match` at positions whose beams are listed; template and beside (positions, width)."""
    beams = whitened.shape[1]
    skirts, largest, trust, left = np.empty(beams), np.empty(beams), np.empty(beams), np.empty(beams)
    for k in range(whitened.shape[0]):
        for i in range(beams):
            skirts[i] = abs(others[k, i])
        largest_near(skirts, misplaced, largest)
        for i in range(beams):
            trust[i] = 1.0 / (noise[i] * explained[k, i] ** 2 + error * error * largest[i] * largest[i])
            left[i] = trust[i] * (whitened[k, i] - others[k, i])
        for p in range(template.shape[0]):
            total, information = 0.0, 1e-300
            for j in range(template.shape[1]):
                value, at = template[p, j], beside[p, j]
                total += value * left[at]
                information += value * value * trust[at]
            power[k, p] = total / information
            variance[k, p] = inflation[p] / information


@njit(cache=True, nogil=True)
def _filter_within(wide, weights, out):  # type: ignore[no-untyped-def]
    """Weighted sums over the neighbors of every beam, of rows with their neighbors beyond the ends."""
    for k in range(out.shape[0]):
        _correlate(weights, wide[k], out[k])


@njit(cache=True, nogil=True)
def _filter(rows, weights, out):  # type: ignore[no-untyped-def]
    """Weighted sums over the neighbors of every beam; weights (width, beams)."""
    width, beams = weights.shape
    padded = np.zeros(beams + width - 1)
    for k in range(rows.shape[0]):
        padded[width // 2 : width // 2 + beams] = rows[k]
        _correlate(weights, padded, out[k])


@njit(cache=True, nogil=True, fastmath=True)
def _correlate(weights, padded, out):  # type: ignore[no-untyped-def]
    """out[i] = sum_j weights[j, i] padded[i + j], four j at a time."""
    width, beams = weights.shape
    out[:] = 0.0
    for j in range(0, width - 3, 4):
        w0, w1, w2, w3 = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        p0, p1 = padded[j : j + beams], padded[j + 1 : j + 1 + beams]
        p2, p3 = padded[j + 2 : j + 2 + beams], padded[j + 3 : j + 3 + beams]
        for i in range(beams):
            out[i] += w0[i] * p0[i] + w1[i] * p1[i] + w2[i] * p2[i] + w3[i] * p3[i]
    for j in range(width - width % 4, width):
        w, p = weights[j], padded[j : j + beams]
        for i in range(beams):
            out[i] += w[i] * p[i]
