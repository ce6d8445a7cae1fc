"""Range and bearing of a planar position: joint Gaussians of state and measurement by EKF or UKF."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit

SMALLEST_RANGE = 1e-6
"""Lower limit of the range in the derivatives, m: at the sensor itself they are undefined."""


@njit(cache=True, nogil=True)
def linearized_range_bearing(select, noise, sensor, mean, cov):  # type: ignore[no-untyped-def]
    """Fill the y blocks of a component by the first-order transform (EKF).

    Args:
        select: Rows that select the position from the state. Shape (2, n).
        noise: R of range (m^2) and bearing (rad^2). Shape (2, 2).
        sensor: Position of the sensor. Shape (2,), m.
        mean: Joint mean; its y entries are written. Shape (n + 2,).
        cov: Joint covariance; its y blocks are written. Shape (n + 2, n + 2).
    """
    n = select.shape[1]
    dx, dy = -sensor[0], -sensor[1]
    for k in range(n):
        dx += select[0, k] * mean[k]
        dy += select[1, k] * mean[k]
    reach = max(math.hypot(dx, dy), SMALLEST_RANGE)
    mean[n], mean[n + 1] = math.hypot(dx, dy), math.atan2(dy, dx)
    H = np.empty((2, n))
    for k in range(n):
        H[0, k] = (dx * select[0, k] + dy * select[1, k]) / reach
        H[1, k] = (dx * select[1, k] - dy * select[0, k]) / (reach * reach)
    for r in range(2):
        for c in range(n):
            value = 0.0
            for k in range(n):
                value += H[r, k] * cov[k, c]
            cov[n + r, c] = value
            cov[c, n + r] = value
    for r in range(2):
        for c in range(r + 1):
            value = noise[r, c]
            for k in range(n):
                value += cov[n + r, k] * H[c, k]
            cov[n + r, n + c] = value
            cov[n + c, n + r] = value


@njit(cache=True, nogil=True)
def unscented_range_bearing(select, noise, sensor, mean, cov):  # type: ignore[no-untyped-def]
    """Fill the y blocks of a component by the unscented transform (Julier and Uhlmann 1997, kappa = 3 - n at least 0).

    Bearings are averaged as differences from that of the mean point, so that the wrap at +-pi has no effect. Arguments
    as in `linearized_range_bearing`.
    """
    n = select.shape[1]
    kappa = max(3.0 - n, 0.0)
    spread = math.sqrt(n + kappa)
    root = np.zeros((n, n))
    for r in range(n):
        for c in range(r + 1):
            value = cov[r, c]
            for k in range(c):
                value -= root[r, k] * root[c, k]
            if r == c:
                # A state entry that is known exactly has no spread.
                root[r, r] = math.sqrt(max(value, 0.0))
            elif root[c, c] > 0.0:
                root[r, c] = value / root[c, c]
    points = np.empty((2 * n + 1, 2))
    center = 0.0
    for p in range(2 * n + 1):
        dx, dy = -sensor[0], -sensor[1]
        for k in range(n):
            value = mean[k]
            if 0 < p <= n:
                value += spread * root[k, p - 1]
            elif p > n:
                value -= spread * root[k, p - n - 1]
            dx += select[0, k] * value
            dy += select[1, k] * value
        bearing = math.atan2(dy, dx)
        if p == 0:
            center = bearing
        turn = bearing - center
        points[p, 0] = math.hypot(dx, dy)
        points[p, 1] = turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    side = 0.5 / (n + kappa)
    first = kappa / (n + kappa)
    average = np.empty(2)
    for r in range(2):
        average[r] = first * points[0, r]
        for p in range(1, 2 * n + 1):
            average[r] += side * points[p, r]
    for r in range(2):
        for c in range(r + 1):
            value = noise[r, c] + first * (points[0, r] - average[r]) * (points[0, c] - average[c])
            for p in range(1, 2 * n + 1):
                value += side * (points[p, r] - average[r]) * (points[p, c] - average[c])
            cov[n + r, n + c] = value
            cov[n + c, n + r] = value
        for k in range(n):
            value = 0.0
            for p in range(n):
                value += side * spread * root[k, p] * (points[p + 1, r] - points[n + p + 1, r])
            cov[n + r, k] = value
            cov[k, n + r] = value
    mean[n] = average[0]
    turn = center + average[1]
    mean[n + 1] = turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
