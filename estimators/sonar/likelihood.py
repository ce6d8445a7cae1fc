"""Likelihood ratios of rows from the powers that they show at each bearing."""

from __future__ import annotations

import numpy as np
from numba import njit

from servotrack.estimators.types import Array

AMPLITUDES = (1.5, 3.0, 6.0)
"""What a target of unknown power may show, in standard deviations of the noise; each is twice the one before."""
MISSED = 0.02
"""Probability that a row does not show a target that is there."""
STRONGEST = 40.0
"""Log likelihood ratio to which a row is scaled down, nats: one row must not outweigh many."""
LARGE = 9.0
"""Standard deviations from which exponentials are taken after their largest one is taken out."""
NOTHING = -40.0
"""Log likelihood ratio below which rounding leaves nothing beside a miss, nats."""
WEIGHTS = tuple(float(np.exp(-(amplitude**2) / 2.0)) for amplitude in AMPLITUDES)
AMPLITUDE_OF_CELL = 3.0
LEAST_OF_CELL = -3.0


def cell_likelihood(rows: Array) -> Array:
    """The paper's: exp(A s - A^2 / 2) of each beam alone, s in robust standard deviations.

    Args:
        rows: Normalized beam powers. Shape (T, beams).

    Returns:
        Shape (T, beams).
    """
    spread = np.median(np.abs(rows - 1.0), axis=1, keepdims=True) / 0.6745
    ratio = AMPLITUDE_OF_CELL * (rows - 1.0) / spread - AMPLITUDE_OF_CELL**2 / 2.0
    return np.exp(np.maximum(_scaled(ratio), LEAST_OF_CELL))


def unknown_power(power: Array, variance: Array) -> Array:
    """Of a target that may be weak or strong: mean over amplitudes of exp(A s - A^2 / 2), which is 1 under noise.

    Args:
        power: That each row shows at each bearing. Shape (T, beams).
        variance: Of the power under noise. Shape (T, beams).

    Returns:
        Shape (T, beams).
    """
    out = np.empty(np.shape(power))
    _unknown(np.asarray(power), np.asarray(variance), out)
    return out


def known_power(power: Array, variance: Array, expected: Array, spread: float) -> Array:
    """Of a target whose power is known but for a relative standard deviation; its mean is 1 under noise.

    Args:
        power: That each row shows at each bearing. Shape (T, beams).
        variance: Of the power under noise. Shape (T, beams).
        expected: Power of the target. Shape (T,).
        spread: Relative standard deviation of the target's power.

    Returns:
        Shape (T, beams).
    """
    out = np.empty(np.shape(power))
    _known(np.asarray(power), np.asarray(variance), np.asarray(expected), spread, out)
    return out


def _scaled(ratio: Array) -> Array:
    top = ratio.max(axis=1, keepdims=True)
    return ratio * np.minimum(1.0, STRONGEST / np.maximum(top, STRONGEST))


@njit(cache=True, nogil=True)
def _unknown(power, variance, out):  # type: ignore[no-untyped-def]
    """See `unknown_power`."""
    for k in range(power.shape[0]):
        row, strongest = out[k], -np.inf
        for i in range(power.shape[1]):
            row[i] = power[k, i] / np.sqrt(variance[k, i])
            strongest = max(strongest, row[i])
        if strongest < LARGE:
            for i in range(row.shape[0]):
                row[i] = _mean_ratio(row[i])
            # The ratio rises with s: no other beam has more than the strongest.
            if np.log(_mean_ratio(strongest)) <= STRONGEST:
                for i in range(row.shape[0]):
                    row[i] = MISSED + (1.0 - MISSED) * row[i]
                continue
            for i in range(row.shape[0]):
                row[i] = np.log(row[i])
        else:
            for i in range(row.shape[0]):
                row[i] = np.log(_mean_ratio(row[i])) if row[i] < LARGE else _log_of_strong(row[i])
        _with_misses(row)


@njit(cache=True, nogil=True)
def _mean_ratio(s):  # type: ignore[no-untyped-def]
    """Mean over amplitudes A of exp(A s - A^2 / 2)."""
    one = np.exp(AMPLITUDES[0] * s)
    two = one * one
    return (one * WEIGHTS[0] + two * WEIGHTS[1] + two * two * WEIGHTS[2]) / 3.0


@njit(cache=True, nogil=True)
def _log_of_strong(s):  # type: ignore[no-untyped-def]
    """Logarithm of `_mean_ratio`, led by the largest amplitude."""
    lead = AMPLITUDES[2] * s - AMPLITUDES[2] ** 2 / 2.0
    total = 1.0
    for a in AMPLITUDES[:2]:
        total += np.exp(a * s - a * a / 2.0 - lead)
    return lead + np.log(total / 3.0)


@njit(cache=True, nogil=True)
def _known(power, variance, expected, spread, out):  # type: ignore[no-untyped-def]
    """See `known_power`."""
    for k in range(power.shape[0]):
        row, mean = out[k], expected[k]
        extra = (spread * mean) ** 2
        for i in range(power.shape[1]):
            noise = variance[k, i]
            width = noise + extra
            # Below this the ratio would rise again: powers far below zero do not speak for a strong target.
            shown = max(power[k, i], -mean * noise / max(extra, 1e-300))
            row[i] = 0.5 * (shown * shown / noise - (shown - mean) ** 2 / width - np.log(width / noise))
        _with_misses(row)


@njit(cache=True, nogil=True)
def _with_misses(row):  # type: ignore[no-untyped-def]
    """Log ratios of a row become ratios of what is seen or missed."""
    scale = STRONGEST / max(row.max(), STRONGEST)
    for i in range(row.shape[0]):
        ratio = row[i] * scale
        row[i] = MISSED + (1.0 - MISSED) * np.exp(ratio) if ratio > NOTHING else MISSED
