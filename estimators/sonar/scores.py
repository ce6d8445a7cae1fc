"""How well a source at each bearing fits a row of the record, by a matched filter over the whole row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from servotrack.estimators.sonar.array import beam_correlation
from servotrack.estimators.sonar.explained import Patterns

Array = NDArray[np.float64]


class Template(NamedTuple):
    """A source's pattern about each look, whitened.

    Attributes:
        values: Of the beams from `reach` below a look to `reach` above. Shape (beams, 2 reach + 1).
        inflation: Variance of a matched sum over the beams, in that of independent beams. Shape (beams,).
    """

    values: Array
    inflation: Array


@dataclass(frozen=True, eq=False)
class RowScores:
    """Matched filter over a whole row, whose neighboring beams share their noise.

    Attributes:
        patterns: Of sources.
        looks: Bearings of the beams, deg. Shape (beams,).
        averages: M of one beam power.
        model_error: Relative standard deviation of what targets explain.
        misplaced: Beams by which a pattern may be misplaced.
        reach: Beams of the matched filter to each side.
        damping: Added to the eigenvalues of the noise's correlation in whitening.
    """

    patterns: Patterns
    looks: Array
    averages: int
    model_error: float = 0.15
    misplaced: int = 4
    reach: int = 24
    damping: float = 1.0

    @cached_property
    def _correlation(self) -> Array:
        p = self.patterns
        return beam_correlation(p.array, p.band.frequencies, self.looks, p.shading)

    @cached_property
    def _neighbors(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        index = np.arange(len(self.looks))[:, None] + np.arange(-self.reach, self.reach + 1)
        return np.clip(index, 0, len(self.looks) - 1), (index >= 0) & (index < len(self.looks))

    @cached_property
    def whitening(self) -> Array:
        """What makes the noise of neighboring beams nearly independent, cut to `reach`. Shape (beams, 2 reach + 1)."""
        values, vectors = np.linalg.eigh(self._correlation)
        whole = (vectors / np.sqrt(np.maximum(values, 0.0) + self.damping)) @ vectors.T
        index, inside = self._neighbors
        return np.ascontiguousarray(np.where(inside, np.take_along_axis(whole, index, 1), 0.0))

    @cached_property
    def _noise(self) -> tuple[Array, Array, NDArray[np.int64]]:
        """Variances of whitened noise, and its covariance about some looks: blocks (some, width, width), looks."""
        index, inside = self._neighbors
        square = np.zeros_like(self._correlation)
        rows = np.broadcast_to(np.arange(len(self.looks))[:, None], index.shape)
        square[rows[inside], index[inside]] = self.whitening[inside]
        covariance = square @ self._correlation @ square.T
        some = np.unique(np.linspace(0, len(self.looks) - 1, 31).astype(int))
        blocks = np.array([covariance[np.ix_(index[i], index[i])] for i in some])
        return np.ascontiguousarray(np.diag(covariance)), blocks, some

    @cached_property
    def _basis(self) -> Array:
        """Whitened pattern of each pure spectrum about every look. Shape (1 + tones, beams * (2 reach + 1))."""
        index, inside = self._neighbors
        cosines = np.cos(np.radians(self.looks))
        whitened = (
            self._whiten(self.patterns.at(mixture, cosines, self.looks))
            for mixture in np.eye(len(self.patterns.tables))
        )
        return np.array([np.where(inside, np.take_along_axis(p, index, 1), 0.0).ravel() for p in whitened])

    def _whiten(self, rows: Array) -> Array:
        out = np.empty_like(rows)
        _filter(np.ascontiguousarray(rows), self._columns, out)
        return out

    @cached_property
    def _columns(self) -> Array:
        return np.ascontiguousarray(self.whitening.T)

    def template(self, mixture: Array) -> Template:
        """The whitened pattern of a mixture of spectra."""
        index, inside = self._neighbors
        used = np.flatnonzero(mixture > 1e-3)
        values = mixture[used[0]] * self._basis[used[0]]
        for i in used[1:]:
            values += mixture[i] * self._basis[i]
        values = values.reshape(index.shape)
        # How much the beams' correlation inflates a sum changes slowly with the look.
        power, blocks, some = self._noise
        few = values[some]
        noise = np.einsum("ij,ijk,ik->i", few, blocks, few)
        inflation = noise / np.einsum("ij,ij->i", few**2, power[index[some]] * inside[some])
        return Template(values, np.interp(np.arange(len(self.looks)), some, inflation))

    def evaluate(self, rows: Array, explained: Array, template: Template) -> tuple[Array, Array]:
        """Power of a source at each bearing and the variance of that power, under noise and the model's errors.

        Args:
            rows: Normalized beam powers. Shape (T, beams).
            explained: Mean of the beam powers by everything else, noise 1. Shape (T, beams).
            template: Of the source.

        Returns:
            power and variance, shape (T, beams) each.
        """
        residual = self._whiten(rows - explained)
        others = np.abs(self._whiten(explained - 1.0))
        skirts = maximum_filter1d(others, 2 * self.misplaced + 1, axis=1)
        noise = self._noise[0] * explained**2 / self.averages
        precision = 1.0 / (noise + (self.model_error * skirts) ** 2)
        power, information = np.empty_like(rows), np.empty_like(rows)
        _match(residual * precision, precision, np.ascontiguousarray(template.values.T), power, information)
        variance = template.inflation / information
        # Noise that is not what the model says shows in the spread of all bearings.
        scores = power / np.sqrt(variance)
        spread = np.median(np.abs(scores), axis=1, keepdims=True) / 0.6745
        return power, variance * np.maximum(spread, 1.0) ** 2


@njit(cache=True, nogil=True, fastmath=True)
def _match(weighted, precision, template, power, information):  # type: ignore[no-untyped-def]
    """Least-squares power of the template about every beam, and its information; template (width, beams)."""
    width, beams = template.shape
    for k in range(weighted.shape[0]):
        total, squares = power[k], information[k]
        total[:] = 0.0
        squares[:] = 0.0
        for j in range(width):
            shift = j - width // 2
            low, count = max(0, -shift), beams - abs(shift)
            shape, signal = template[j, low : low + count], weighted[k, low + shift : low + shift + count]
            trust = precision[k, low + shift : low + shift + count]
            here, there = total[low : low + count], squares[low : low + count]
            for i in range(count):
                here[i] += shape[i] * signal[i]
                there[i] += shape[i] * shape[i] * trust[i]
        for i in range(beams):
            total[i] /= squares[i]


@njit(cache=True, nogil=True, fastmath=True)
def _filter(rows, weights, out):  # type: ignore[no-untyped-def]
    """Weighted sums of the beams about every beam; weights (width, beams)."""
    width, beams = weights.shape
    for k in range(rows.shape[0]):
        out[k] = 0.0
        for j in range(width):
            shift = j - width // 2
            low, count = max(0, -shift), beams - abs(shift)
            share, row = weights[j, low : low + count], rows[k, low + shift : low + shift + count]
            here = out[k, low : low + count]
            for i in range(count):
                here[i] += share[i] * row[i]
