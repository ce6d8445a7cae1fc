"""Kalman update of a matrix whose rows share one covariance.

With isotropic noise the rows of the total image Jacobian are independent, share the same ds and therefore keep the same
covariance: one covariance of size n + 1 replaces a filter of dimension m (n + 1). The Kalman filter, its
outlier-robust variants, RLS and the level filter differ only in how they predict this covariance and in the
measurement variance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.definite import is_definite, repair
from servotrack.estimators.jacobian.contract import Increment
from servotrack.estimators.types import Array, Mask


class SharedUpdate(NamedTuple):
    """Result of `shared_update`.

    Attributes:
        mean: Mean after the measurement. Shape (*batch, m, d).
        covariance: Covariance of every row of `mean`, symmetric positive definite. Shape (*batch, d, d).
        log_likelihood: Log density of the measurement, 0 where none was used. Shape (*batch,).
        nis: Normalized innovation squared divided by m, 0 where no measurement was used. Shape (*batch,).
    """

    mean: Array
    covariance: Array
    log_likelihood: Array
    nis: Array


def interval(increment: Increment) -> Array:
    """The interval vector ds = [dtheta; dt] (Zhang 2011, eq. 6). Shape (*batch, n + 1), rad and s."""
    return np.concatenate([increment.joints, increment.time[..., None]], axis=-1)


def shared_update(
    mean: Array, covariance: Array, direction: Array, measured: Array, variance: Array | float, used: Mask
) -> SharedUpdate:
    """Update with the measurement z = mean h + noise, in Joseph form.

    The covariance stays positive definite; where rounding prevents that, it is repaired (`servotrack.estimators.
    definite`).

    Args:
        mean: Predicted mean. Shape (*batch, m, d).
        covariance: Predicted covariance shared by the rows of `mean`. Shape (*batch, d, d).
        direction: h. Shape (*batch, d).
        measured: z. Shape (*batch, m).
        variance: Variance of each component of the noise, > 0. Shape (*batch,) or a number.
        used: Mask of the rows with a measurement; the others stay unchanged. Shape (*batch,), bool.

    Returns:
        Mean and covariance after the measurement, its log likelihood and NIS.
    """
    batch = mean.shape[:-2]
    rows = math.prod(batch)
    m, d = mean.shape[-2:]
    new_mean, new_covariance, log_likelihood, nis = _shared_update(
        mean.reshape(rows, m, d),
        covariance.reshape(rows, d, d),
        direction.reshape(rows, d),
        measured.reshape(rows, m),
        np.full(rows, variance) if np.ndim(variance) == 0 else np.reshape(variance, rows),
        used.reshape(rows),
    )
    return SharedUpdate(
        new_mean.reshape(mean.shape),
        new_covariance.reshape(covariance.shape),
        log_likelihood.reshape(batch),
        nis.reshape(batch),
    )


@njit(cache=True, nogil=True)
def _shared_update(mean, covariance, direction, measured, variance, used):  # type: ignore[no-untyped-def]
    rows, m, d = mean.shape
    new_mean = mean.copy()
    new_covariance = covariance.copy()
    log_likelihood = np.zeros(rows)
    nis = np.zeros(rows)
    spread = np.empty(d)
    gain = np.empty(d)
    half, factor, before = np.empty((d, d)), np.empty((d, d)), np.empty(d)
    for row in range(rows):
        if not used[row]:
            continue
        h = direction[row]
        total = variance[row]
        for i in range(d):
            spread[i] = 0.0
            for j in range(d):
                spread[i] += covariance[row, i, j] * h[j]
            total += h[i] * spread[i]
        for i in range(d):
            gain[i] = spread[i] / total
        squares = 0.0
        for i in range(m):
            innovation = measured[row, i]
            for j in range(d):
                innovation -= mean[row, i, j] * h[j]
            squares += innovation * innovation
            for j in range(d):
                new_mean[row, i, j] += innovation * gain[j]
        # Joseph form: (I - K h') P (I - K h')' + r K K'.
        for i in range(d):
            for j in range(d):
                half[i, j] = covariance[row, i, j] - gain[i] * spread[j]
        for i in range(d):
            projected = 0.0
            for j in range(d):
                projected += half[i, j] * h[j]
            for j in range(i + 1):
                value = half[i, j] - projected * gain[j] + variance[row] * gain[i] * gain[j]
                new_covariance[row, i, j] = value
                new_covariance[row, j, i] = value
        if not is_definite(new_covariance[row], 0.0, factor):
            for i in range(d):
                before[i] = covariance[row, i, i]
            repair(new_covariance[row], before, factor)
        nis[row] = squares / (total * m)
        log_likelihood[row] = -0.5 * (squares / total + m * np.log(2.0 * np.pi * total))
    return new_mean, new_covariance, log_likelihood, nis
