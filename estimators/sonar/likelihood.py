"""Likelihood ratios of rows from the powers that they show at each bearing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AMPLITUDES = (1.5, 3.0, 6.0)
"""What a target of unknown power may show, in standard deviations of the noise."""
MISSED = 0.02
"""Probability that a row does not show a target that is there."""
STRONGEST = 40.0
"""Log likelihood ratio to which a row is scaled down, nats: one row must not outweigh many."""
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
    s = power / np.sqrt(variance)
    # For s above all amplitudes the largest one leads: its ratio is taken out before the exponentials.
    lead = np.maximum(AMPLITUDES[0] * s - AMPLITUDES[0] ** 2 / 2.0, AMPLITUDES[-1] * s - AMPLITUDES[-1] ** 2 / 2.0)
    total = sum(np.exp(amplitude * s - amplitude**2 / 2.0 - lead) for amplitude in AMPLITUDES)
    return _with_misses(lead + np.log(total / len(AMPLITUDES)))


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
    extra = (spread * expected[:, None]) ** 2
    width = variance + extra
    # Below this the ratio would rise again: powers far below zero do not speak for a strong target.
    shown = np.maximum(power, -expected[:, None] * variance / np.maximum(extra, 1e-300))
    ratio = shown**2 / variance - (shown - expected[:, None]) ** 2 / width - np.log(width / variance)
    return _with_misses(0.5 * ratio)


def _scaled(ratio: Array) -> Array:
    top = ratio.max(axis=1, keepdims=True)
    return ratio * np.minimum(1.0, STRONGEST / np.maximum(top, STRONGEST))


def _with_misses(ratio: Array) -> Array:
    return MISSED + (1.0 - MISSED) * np.exp(_scaled(ratio))
