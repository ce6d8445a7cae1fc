"""Uniform line array under plane waves: steering, beam patterns, beamforming, and the noise of beam powers.

Powers are relative to the noise of one element in one frequency bin. Shading weights have unit norm: white noise has
beam power 1, and a source of unit power has the array's gain (48 without shading) in the beam towards it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import cosine, sum_in_order
from servotrack.estimators.symmetric import weighted_rows
from servotrack.estimators.types import Array, ComplexArray
from servotrack.estimators.validation import as_numbers

Shading = Literal["conventional", "chebyshev"]

SIDELOBE_ATTENUATION = 30.0
"""Attenuation of the sidelobes below the main lobe with Chebyshev shading, dB."""


@dataclass(frozen=True)
class LineArray:
    """Omnidirectional elements on a line; bearings are measured from the line, 0 to 180 deg.

    Bearing 0 is the direction from the last to the first element: a wave from there reaches element 0 first.

    Attributes:
        elements: Number N of elements. Larger values give narrower beams.
        spacing: Distance between neighboring elements, m.
        sound_speed: Speed of sound in the medium, m/s.
    """

    elements: int = 48
    spacing: float = 0.5
    sound_speed: float = 1500.0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        if self.elements < 2:
            raise ValueError(f"elements must be at least 2, got {self.elements!r}")
        for name in ("spacing", "sound_speed"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")


@dataclass(frozen=True)
class Band:
    """Frequency bins over which a receiver sums.

    Attributes:
        low: Center of the first bin, Hz.
        high: Upper limit of the centers, Hz.
        step: Width of one bin, Hz.
    """

    low: float = 500.0
    high: float = 1600.0
    step: float = 10.0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        if not 0.0 < self.low <= self.high < np.inf:
            raise ValueError(f"low and high must satisfy 0 < low <= high, got low={self.low!r}, high={self.high!r}")
        if not 0.0 < self.step < np.inf:
            raise ValueError(f"step must be positive, got {self.step!r}")

    @property
    def frequencies(self) -> Array:
        """Centers of the bins, Hz. Shape (F,)."""
        count = int((self.high - self.low) / self.step + 1e-6) + 1
        return self.low + self.step * np.arange(count, dtype=np.float64)


def bearings(count: int = 721) -> Array:
    """Bearings of beams from 0 to 180 deg in equal steps. Shape (count,)."""
    if count < 2:
        raise ValueError(f"count must be at least 2, got {count!r}")
    return np.linspace(0.0, 180.0, count)


def shading_weights(array: LineArray, shading: Shading = "conventional") -> Array:
    """Weights of the elements, of unit norm. Shape (N,).

    Raises:
        ValueError: The shading is unknown.
    """
    if shading not in get_args(Shading):
        raise ValueError(f"shading must be one of {', '.join(get_args(Shading))}, got {shading!r}")
    if shading == "conventional":
        return np.full(array.elements, 1.0 / np.sqrt(array.elements), np.float64)
    weights = _chebyshev_weights(array.elements)
    return np.asarray(weights / math.sqrt(sum_in_order(weights**2)), np.float64)


def steering(array: LineArray, frequencies: ArrayLike, bearings_deg: ArrayLike) -> ComplexArray:
    """Phases of plane waves at the elements, exp(-2 pi j f d n cos(theta) / c).

    Args:
        array: Line array of the receiver.
        frequencies: Frequencies, Hz. Shape (F,).
        bearings_deg: Bearings of the sources, deg. Shape (S,).

    Returns:
        Complex phases of unit modulus. Shape (F, S, N).
    """
    delay = array.spacing / array.sound_speed * cosines(bearings_deg)
    phase = np.asarray(frequencies, np.float64)[:, None, None] * delay[:, None] * np.arange(array.elements)
    return unit_phasors(-2.0 * np.pi * phase)


def unit_phasors(angles: ArrayLike) -> ComplexArray:
    """Complex numbers exp(j angle) of angles in rad, element by element."""
    x = np.ascontiguousarray(angles, np.float64)
    out = np.empty(x.shape, np.complex128)
    _phasors(x.reshape(-1), out.reshape(-1))
    return out.reshape(np.shape(angles))


def cosines(bearings_deg: ArrayLike) -> Array:
    """Cosines of bearings in deg, element by element."""
    return cosine(np.radians(np.asarray(bearings_deg, np.float64)))


def beam_pattern(
    array: LineArray,
    frequencies: ArrayLike,
    weights: ArrayLike,
    beam_deg: ArrayLike,
    source_deg: ArrayLike,
    shading: Shading = "conventional",
) -> Array:
    """Contribution of plane waves to the mean beam power over the band, by direct summation.

    Args:
        array: Line array of the receiver.
        frequencies: Centers of the band's bins, Hz. Shape (F,).
        weights: The source's power in each bin, per element. Shape (F,).
        beam_deg: Directions of the beams, deg. Shape (beams,).
        source_deg: Directions of the sources, deg. Shape (*sources,).
        shading: Shading of the elements.

    Returns:
        1/F sum_f weights_f |w^H a_f|^2. Shape (*sources, beams).
    """
    offset = cosines(source_deg)[..., None] - cosines(beam_deg)
    return _pattern_of_offset(array, frequencies, weights, offset, shading)


@dataclass(frozen=True, eq=False)
class PatternTable:
    """Table of a beam pattern over the difference of cosines, for many sources.

    Attributes:
        step: Step of the difference of cosines.
        values: Pattern at the differences 0, step, 2 step, ... 2. Shape (P,).
    """

    step: float
    values: Array

    def at(self, beam_deg: ArrayLike, source_deg: ArrayLike) -> Array:
        """Pattern of sources in beams, equal to `beam_pattern` up to the table's step. Shape (*sources, beams)."""
        return self.at_offset(np.abs(cosines(source_deg)[..., None] - cosines(beam_deg)))

    def at_offset(self, offset: Array) -> Array:
        """Pattern at differences of cosines from 0 to 2, of any shape."""
        position = offset / self.step
        below = np.minimum(position.astype(np.int64), len(self.values) - 2)
        part = position - below
        return (1.0 - part) * self.values[below] + part * self.values[below + 1]


def tabulate_pattern(
    array: LineArray, frequencies: ArrayLike, weights: ArrayLike, shading: Shading = "conventional", points: int = 10001
) -> PatternTable:
    """Tabulate the `beam_pattern` of one spectrum.

    With the default array and number of points, the error of the table is below 1e-4 of the peak.

    Args:
        array: Line array of the receiver.
        frequencies: Centers of the band's bins, Hz. Shape (F,).
        weights: The source's power in each bin, per element. Shape (F,).
        shading: Shading of the elements.
        points: Number of points from 0 to 2 in the difference of cosines.
    """
    offset = np.linspace(0.0, 2.0, points)
    return PatternTable(2.0 / (points - 1), _pattern_of_offset(array, frequencies, weights, offset, shading))


def beamform(
    array: LineArray,
    frequencies: ArrayLike,
    snapshots: NDArray[np.complexfloating],
    beam_deg: ArrayLike,
    shading: Shading = "conventional",
) -> Array:
    """Beam powers of one record or many, averaged over frequencies and snapshots.

    The power is computed from the sums of the sample covariance along its diagonals, about ten times faster than by
    beams of every snapshot.

    Args:
        array: Line array of the receiver.
        frequencies: Centers of the band's bins, Hz. Shape (F,).
        snapshots: Spectra at the elements. Shape (*records, K, F, N), complex.
        beam_deg: Directions of the beams, deg. Shape (beams,).
        shading: Shading of the elements.

    Returns:
        1/(F K) sum_f sum_s |w^H x_fs|^2. Shape (*records, beams).

    Raises:
        ValueError: The snapshots do not have these numbers of frequencies and elements.
    """
    x = np.asarray(snapshots)
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    N = array.elements
    if x.ndim < 3 or x.shape[-2:] != (len(f), N):
        raise ValueError(f"snapshots must have shape (*records, K, {len(f)}, {N}), got {x.shape}")
    beam_bearings = np.atleast_1d(np.asarray(beam_deg, np.float64))
    basis = _lag_basis(array, f.tobytes(), beam_bearings.tobytes())
    w = shading_weights(array, shading)
    records = x.reshape(-1, *x.shape[-3:])
    powers = np.empty((len(records), len(beam_bearings)))
    for i, record in enumerate(records):
        by_bin = np.ascontiguousarray((record * w).transpose(1, 0, 2), np.complex128)
        lag = np.empty((len(f), 2 * N - 1))
        _diagonal_sums(by_bin.real.copy(), by_bin.imag.copy(), lag)
        powers[i] = weighted_rows(lag.reshape(-1), basis)
    return powers.reshape(*x.shape[:-3], len(beam_bearings)) / (len(f) * x.shape[-3])


def beam_correlation(
    array: LineArray, frequencies: ArrayLike, beam_deg: ArrayLike, shading: Shading = "conventional"
) -> Array:
    """Correlation of the powers of two beams in white noise: mean over f of |w_f(i)^H w_f(j)|^2.

    The noise power of a beam is Gamma(M, 1/M) distributed with M = F K averages. Neighbors share most of their noise.

    Args:
        array: Line array of the receiver.
        frequencies: Centers of the band's bins, Hz. Shape (F,).
        beam_deg: Directions of the beams, deg. Shape (beams,).
        shading: Shading of the elements.

    Returns:
        Correlations, shape (beams, beams), with ones on the diagonal.
    """
    u = cosines(beam_deg)
    w = shading_weights(array, shading)
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    # The weights of a beam are w exp(j n phase), so the inner product of two beams is the pattern of the weights w^2.
    offset = np.linspace(0.0, 2.0, 10001)
    table = PatternTable(2e-4, _dirichlet_power(array, f, np.ones(len(f)), offset, w**2))
    return table.at_offset(np.abs(u[:, None] - u))


def normalize(powers: ArrayLike, averages: float = 1110) -> Array:
    """Divide beam powers by their noise level, a truncated mean over bearing.

    The first level is the median. Two passes replace it by the mean of the powers within 2.5 standard deviations of
    the noise.

    Args:
        powers: Beam powers of one or more rows. Shape (*rows, beams).
        averages: Number M = F K of averages in one power; the standard deviation of the noise is 1/sqrt(M).

    Returns:
        Powers with noise mean 1. Shape (*rows, beams).

    Raises:
        ValueError: Powers are NaN, infinite or negative, there are none, or the median of a row is 0.
    """
    z = as_numbers("powers", powers)
    if z.ndim < 1 or not z.shape[-1]:
        raise ValueError(f"powers must have shape (*rows, beams), got {z.shape}")
    bad = ~(np.isfinite(z) & (z >= 0.0))
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"powers must be finite and not negative, got {z[at]} at index {at}; leave such rows out")
    level = np.median(z, axis=-1, keepdims=True)
    if not (level > 0.0).all():
        raise ValueError("powers must be positive in most beams, got a row whose median is 0; leave such rows out")
    for _ in range(2):
        kept = np.abs(z - level) <= 2.5 / np.sqrt(averages) * level
        count = kept.sum(axis=-1, keepdims=True)
        # The order of `sum` depends on the processor.
        mean = np.cumsum(np.where(kept, z, 0.0), axis=-1)[..., -1:] / np.maximum(count, 1)
        level = np.where(count > 0, mean, level)
    return z / level


def _pattern_of_offset(
    array: LineArray, frequencies: ArrayLike, weights: ArrayLike, offset: Array, shading: Shading
) -> Array:
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    power = np.broadcast_to(np.asarray(weights, np.float64), f.shape)
    return _dirichlet_power(array, f, power, offset, shading_weights(array, shading))


def _dirichlet_power(array: LineArray, frequencies: Array, power: Array, offset: Array, w: Array) -> Array:
    """1/F sum_f power_f |sum_n w_n exp(2 pi j f d n offset / c)|^2, by lags. Shape of offset."""
    lags = np.array([sum_in_order(w[: len(w) - lag] * w[lag:]) * (2.0 if lag else 1.0) for lag in range(len(w))])
    total = np.zeros(offset.size)
    rates = 2.0 * np.pi * frequencies * array.spacing / array.sound_speed
    _add_cosine_series(rates, np.ascontiguousarray(power), lags, np.ascontiguousarray(offset).reshape(-1), total)
    # In a null the rounded sum may be negative.
    return np.maximum(total.reshape(offset.shape) / len(frequencies), 0.0)


@njit(cache=True, nogil=True)
def _add_cosine_series(rates, power, lags, offset, total):  # type: ignore[no-untyped-def]
    """Add sum_f power_f sum_l lags_l cos(l rate_f offset) to `total`, by Clenshaw's recurrence."""
    count = len(offset)
    twice, here, above = np.empty(count), np.empty(count), np.empty(count)
    for f in range(len(rates)):
        if power[f] == 0.0:
            continue
        for i in range(count):
            twice[i] = 2.0 * math.cos(rates[f] * offset[i])
        above[:] = 0.0
        here[:] = lags[-1]
        for lag in range(len(lags) - 2, 0, -1):
            value = lags[lag]
            for i in range(count):
                next_one = twice[i] * here[i] - above[i] + value
                above[i] = here[i]
                here[i] = next_one
        for i in range(count):
            total[i] += power[f] * (0.5 * twice[i] * here[i] - above[i] + lags[0])


@njit(cache=True, nogil=True)
def _diagonal_sums(real, imaginary, lag):  # type: ignore[no-untyped-def]
    """Sums of the sample covariance along its diagonals: real parts of lags 0 to N - 1, then imaginary ones from 1.

    Real and imaginary parts of the snapshots have shape (F, K, N), lag (F, 2N - 1).
    """
    bins, count, elements = real.shape
    for f in range(bins):
        lag[f] = 0.0
        for k in range(count):
            x, y = real[f, k], imaginary[f, k]
            for i in range(elements):
                for distance in range(elements - i):
                    lag[f, distance] += x[i + distance] * x[i] + y[i + distance] * y[i]
                for distance in range(1, elements - i):
                    lag[f, elements - 1 + distance] += y[i + distance] * x[i] - x[i + distance] * y[i]


@njit(cache=True, nogil=True)
def _phasors(x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = complex(math.cos(x[i]), math.sin(x[i]))


def _chebyshev_weights(elements: int) -> Array:
    """Dolph's weights, the inverse Fourier transform of a Chebyshev polynomial; the largest is 1."""
    order = elements - 1
    stretch = math.cosh(math.acosh(10.0 ** (SIDELOBE_ATTENUATION / 20.0)) / order)
    response = []
    for k in range(elements):
        x = stretch * math.cos(math.pi * k / elements)
        inside = math.cos(order * math.acos(max(min(x, 1.0), -1.0)))
        outside = math.copysign(1.0, x) ** order * math.cosh(order * math.acosh(max(abs(x), 1.0)))
        response.append(inside if abs(x) <= 1.0 else outside)
    weights = [
        sum_in_order([r * math.cos(2.0 * math.pi * k * (n - order / 2.0) / elements) for k, r in enumerate(response)])
        for n in range(elements)
    ]
    return np.array(weights) / max(weights)


@lru_cache(maxsize=4)
def _lag_basis(array: LineArray, frequencies: bytes, beam_bearings: bytes) -> Array:
    """Contribution of each (bin, lag) to each beam. Shape (F (2N - 1), beams)."""
    f, u = np.frombuffer(frequencies), cosines(np.frombuffer(beam_bearings))
    N = array.elements
    lag = np.arange(N)
    phase = 2.0 * np.pi * array.spacing / array.sound_speed * f[:, None, None] * lag[:, None] * u
    basis = np.empty((len(f), 2 * N - 1, len(u)))
    waves = unit_phasors(phase)
    basis[:, :N] = np.where(lag[:, None] == 0, 1.0, 2.0) * waves.real
    basis[:, N:] = -2.0 * waves.imag[:, 1:]
    basis.setflags(write=False)
    return basis.reshape(-1, len(u))
