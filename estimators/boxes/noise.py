"""Noise of motion and detections of a sequence, learned from the innovations of its tracks.

The innovations of a Kalman filter with the right noise have their predicted variance and are white (Mehra 1970). If
they are larger, all noise is too small; if successive ones have the same sign, the filter lags and the process noise is
too small; if signs alternate, it follows the detections too closely. Four pairs of scales are learned: center column,
center row, width and height.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


class NoiseScales(NamedTuple):
    """Logarithms of the factors of the noise variances, and the number of innovations that they are based on.

    Attributes:
        measurement: Factors of the variances of detections: center column, center row, width, height. Shape (4,).
        process: Factors of the spectral densities of acceleration along columns and rows, and of the random walks of
            width and height. Shape (4,).
        number: Number of innovations, limited.
    """

    measurement: Array
    process: Array
    number: float


def initial_noise() -> NoiseScales:
    """Scales before the first innovation: all factors are 1."""
    return NoiseScales(np.zeros(4), np.zeros(4), 0.0)


class NoiseLearning(NamedTuple):
    """Gains of the learning of noise.

    Attributes:
        prior: Number of innovations that the initial noise counts for. Raising it learns more slowly at first.
        memory: Largest number of innovations that count. Raising it learns more slowly later.
        size: Gains of the two scales for a normalized squared innovation above 1: measurement, process.
        lag: Gains of the two scales for a product of successive innovations: measurement (lowered), process (raised).
        return_rate: Rate at which scales return to 1. Raising it keeps them nearer to the initial noise.
        largest: Limit of a normalized innovation.
        limits: Limits of the absolute log factors: measurement, process.
    """

    prior: float = 15.0
    memory: float = 400.0
    size: tuple[float, float] = (0.4, 0.7)
    lag: tuple[float, float] = (0.5, 2.5)
    return_rate: float = 0.3
    largest: float = 3.0
    limits: tuple[float, float] = (3.0, 4.0)


@njit(cache=True, nogil=True)
def learn_noise(measurement, process, number, innovation, before, counts, rules):  # type: ignore[no-untyped-def]
    """One step of stochastic approximation; returns the new scales and number.

    Args:
        measurement: Log factors of the measurement noise. Shape (4,).
        process: Log factors of the process noise. Shape (4,).
        number: Number of innovations so far.
        innovation: Normalized innovations of this frame. Shape (T, 4).
        before: Normalized innovations of the last frame, zero for tracks without a detection then. Shape (T, 4).
        counts: Mask of the tracks to learn from. Shape (T,).
        rules: Fields of a `NoiseLearning`.
    """
    prior, memory, size, lag, back, largest, limits = rules
    total = 0
    square, product = np.zeros(4), np.zeros(4)
    for i in range(innovation.shape[0]):
        if not counts[i]:
            continue
        total += 1
        for k in range(4):
            new = min(max(innovation[i, k], -largest), largest)
            square[k] += new * new - 1.0
            product[k] += new * min(max(before[i, k], -largest), largest)
    number = min(number + total, memory)
    rate = 1.0 / (prior + number)
    out, moved = measurement.copy(), process.copy()
    for k in range(4):
        out[k] += rate * (size[0] * square[k] - lag[0] * product[k] - back * total * out[k])
        moved[k] += rate * (size[1] * square[k] + lag[1] * product[k] - back * total * moved[k])
        out[k] = math.copysign(min(abs(out[k]), limits[0]), out[k])
        moved[k] = math.copysign(min(abs(moved[k]), limits[1]), moved[k])
    return out, moved, number
