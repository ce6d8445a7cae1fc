"""Likelihood ratios of rows, from the power at each bearing."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.rules import LikelihoodRules
from servotrack.estimators.types import Array

LARGE_SCORE = 9.0
"""Standard deviations from which exponentials are computed relative to the largest one, against overflow."""
NEGLIGIBLE_LOG_RATIO = -40.0
"""Log likelihood ratio below which a ratio vanishes by rounding beside the miss probability, nats."""


def cell_likelihood(rows: Array, rules: LikelihoodRules) -> Array:
    """Likelihood ratio of single cells (Jiang and Zhou 2016): exp(A s - A^2 / 2) per beam, s in robust deviations.

    Args:
        rows: Normalized beam powers. Shape (T, beams).
        rules: Amplitude A and limits of the ratio.

    Returns:
        Likelihood ratios. Shape (T, beams).
    """
    # A row in which most beams are equal has no spread.
    spread = np.maximum(np.median(np.abs(rows - 1.0), axis=1, keepdims=True) / 0.6745, 1e-12)
    ratio = rules.cell_amplitude * (rows - 1.0) / spread - rules.cell_amplitude**2 / 2.0
    return np.exp(np.maximum(_scaled(ratio, rules.max_log_ratio), -rules.cell_max_penalty))


def unknown_power(power: Array, variance: Array, rules: LikelihoodRules) -> Array:
    """Likelihood ratio of a target of unknown power: mean over amplitudes A of exp(A s - A^2 / 2), 1 under noise.

    Args:
        power: Power of each row at each bearing. Shape (T, beams).
        variance: Variance of the power under noise. Shape (T, beams).
        rules: Amplitudes, miss probability and limit of the ratio.

    Returns:
        Likelihood ratios. Shape (T, beams).
    """
    out = np.empty(np.shape(power))
    weights = tuple(float(np.exp(-(amplitude**2) / 2.0)) for amplitude in rules.amplitudes)
    miss, limit = rules.miss_probability, rules.max_log_ratio
    _unknown(np.asarray(power), np.asarray(variance), rules.amplitudes, weights, miss, limit, out)
    return out


def known_power(power: Array, variance: Array, expected: Array, spread: float, rules: LikelihoodRules) -> Array:
    """Likelihood ratio of a target whose power is known up to a relative standard deviation; mean 1 under noise.

    Args:
        power: Power of each row at each bearing. Shape (T, beams).
        variance: Variance of the power under noise. Shape (T, beams).
        expected: Expected power of the target. Shape (T,).
        spread: Relative standard deviation of the target's power.
        rules: Miss probability and limit of the ratio.

    Returns:
        Likelihood ratios. Shape (T, beams).
    """
    out = np.empty(np.shape(power))
    miss, limit = rules.miss_probability, rules.max_log_ratio
    _known(np.asarray(power), np.asarray(variance), np.asarray(expected), spread, miss, limit, out)
    return out


def _scaled(ratio: Array, limit: float) -> Array:
    top = ratio.max(axis=1, keepdims=True)
    return ratio * np.minimum(1.0, limit / np.maximum(top, limit))


@njit(cache=True, nogil=True)
def _unknown(power, variance, amplitudes, weights, miss, limit, out):  # type: ignore[no-untyped-def]
    """See `unknown_power`."""
    for k in range(power.shape[0]):
        row, strongest = out[k], -np.inf
        for i in range(power.shape[1]):
            row[i] = power[k, i] / np.sqrt(variance[k, i])
            strongest = max(strongest, row[i])
        if strongest < LARGE_SCORE:
            for i in range(row.shape[0]):
                row[i] = _mean_ratio(row[i], amplitudes, weights)
            # The ratio rises with s, so the strongest beam has the largest one.
            if np.log(_mean_ratio(strongest, amplitudes, weights)) <= limit:
                for i in range(row.shape[0]):
                    row[i] = miss + (1.0 - miss) * row[i]
                continue
            for i in range(row.shape[0]):
                row[i] = np.log(row[i])
        else:
            for i in range(row.shape[0]):
                if row[i] < LARGE_SCORE:
                    row[i] = np.log(_mean_ratio(row[i], amplitudes, weights))
                else:
                    row[i] = _log_of_strong(row[i], amplitudes)
        _with_misses(row, miss, limit)


@njit(cache=True, nogil=True)
def _mean_ratio(s, amplitudes, weights):  # type: ignore[no-untyped-def]
    """Mean over amplitudes A, each twice the one before, of exp(A s - A^2 / 2)."""
    one = np.exp(amplitudes[0] * s)
    two = one * one
    return (one * weights[0] + two * weights[1] + two * two * weights[2]) / 3.0


@njit(cache=True, nogil=True)
def _log_of_strong(s, amplitudes):  # type: ignore[no-untyped-def]
    """Logarithm of `_mean_ratio`, computed relative to the term of the largest amplitude."""
    lead = amplitudes[2] * s - amplitudes[2] ** 2 / 2.0
    total = 1.0
    for a in amplitudes[:2]:
        total += np.exp(a * s - a * a / 2.0 - lead)
    return lead + np.log(total / 3.0)


@njit(cache=True, nogil=True)
def _known(power, variance, expected, spread, miss, limit, out):  # type: ignore[no-untyped-def]
    """See `known_power`."""
    for k in range(power.shape[0]):
        row, mean = out[k], expected[k]
        extra = (spread * mean) ** 2
        for i in range(power.shape[1]):
            noise = variance[k, i]
            width = noise + extra
            # Below this power the ratio would rise again: powers far below 0 are no evidence for a strong target.
            shown = max(power[k, i], -mean * noise / max(extra, 1e-300))
            row[i] = 0.5 * (shown * shown / noise - (shown - mean) ** 2 / width - np.log(width / noise))
        _with_misses(row, miss, limit)


@njit(cache=True, nogil=True)
def _with_misses(row, miss, limit):  # type: ignore[no-untyped-def]
    """Convert the log ratios of a row to ratios that include the miss probability, in place."""
    scale = limit / max(row.max(), limit)
    for i in range(row.shape[0]):
        ratio = row[i] * scale
        row[i] = miss + (1.0 - miss) * np.exp(ratio) if ratio > NEGLIGIBLE_LOG_RATIO else miss
