"""Plan a sensor's path by dynamic programming over its places, for targets whose paths are given."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

LOST_ERROR = 0.5
"""GOSPA / c of a target that is not reported: an estimate of larger expected error is better left out."""
NEW_VARIANCE = 1e4
"""Variance of the position of a target before its first measurement, m^2. It only has to exceed the sensor's by far."""


@njit(cache=True, nogil=True)
def relative_error(deviation, cutoff):  # type: ignore[no-untyped-def]
    """Expected min(d, c) / c of the distance d of a Gaussian in the plane with this standard deviation per axis."""
    if deviation <= 0.0:
        return 0.0
    return deviation / cutoff * math.sqrt(0.5 * math.pi) * math.erf(cutoff / (deviation * math.sqrt(2.0)))


def relative_errors(deviations: Array, cutoff: float) -> Array:
    """`relative_error` of several standard deviations (k,), m. Shape (k,)."""
    safe = np.maximum(deviations, 1e-12)
    return np.asarray(safe / cutoff * math.sqrt(0.5 * math.pi) * erf(cutoff / (safe * math.sqrt(2.0))))


@njit(cache=True, nogil=True)
def _advanced(center, half, place, weight, certainty, spread, numbers):  # type: ignore[no-untyped-def]
    """Advance what is known of all targets by one scan in place; return the expected cost of the scan.

    `certainty` (n,) is the probability that a target is tracked, `spread` (n, 3) its covariance per axis: position,
    both, velocity. `numbers`: period, process noise, measurement variance, detection probability, velocity variance of
    a new target, cut-off.
    """
    dt, q, r, detection, fresh, cutoff = numbers
    cost = 0.0
    for i in range(weight.shape[0]):
        if weight[i] <= 0.0:
            continue
        pp, pv, vv = spread[i]
        pp += dt * (2.0 * pv + dt * vv) + q * dt**3 / 3.0
        pv += dt * vv + q * dt**2 / 2.0
        vv += q * dt
        if abs(place[i, 0] - center[0]) <= half[0] and abs(place[i, 1] - center[1]) <= half[1]:
            if certainty[i] < 0.01:
                pp, pv, vv = NEW_VARIANCE, 0.0, fresh
            s = pp + r
            pp, pv, vv = pp - detection * pp * pp / s, pv - detection * pp * pv / s, vv - detection * pv * pv / s
            certainty[i] += detection * (1.0 - certainty[i])
        spread[i, 0], spread[i, 1], spread[i, 2] = pp, pv, vv
        error = min(relative_error(math.sqrt(pp), cutoff), LOST_ERROR)
        cost += weight[i] * (certainty[i] * error + LOST_ERROR * (1.0 - certainty[i]))
    return cost


@njit(cache=True, nogil=True)
def plan_center(  # type: ignore[no-untyped-def]
    center, rate, limit, half, places, weights, certainty, spread, numbers, decisions, hold
):
    """Return the next center of the field of view, shape (2,), m: the first step of the best path found.

    The path is a sequence of `decisions` moves of -1, 0 or 1 times the rate along each axis, each held for `hold`
    scans. At each depth the best path to each place is kept.

    Args:
        center: Center of the field of view now. Shape (2,), m.
        rate: Largest change of each coordinate per scan. Shape (2,), m; 0 for an axis that does not move.
        limit: Largest absolute coordinate of the center. Shape (2,), m.
        half: Half sides of the field of view. Shape (2,), m.
        places: Positions of the targets at the coming scans. Shape (decisions * hold, n, 2), m.
        weights: Probabilities of existence of the targets. Shape (decisions * hold, n).
        certainty: Probability that each target is tracked. Shape (n,).
        spread: Covariance of each target per axis: position, both, velocity. Shape (n, 3).
        numbers: See `_advanced`.
        decisions: Number of moves. Raising it looks further ahead and takes the cube of the time.
        hold: Scans for which a move is held. Raising it looks further ahead with coarser paths.
    """
    n, side = weights.shape[1], 2 * decisions + 1
    cost = np.full((side, side), np.inf)
    at = np.zeros((side, side, 2))
    first = np.zeros((side, side, 2))
    known = np.zeros((side, side, n))
    widths = np.zeros((side, side, n, 3))
    cost[decisions, decisions] = 0.0
    at[decisions, decisions] = center
    known[decisions, decisions] = certainty
    widths[decisions, decisions] = spread
    here, seen, width, begin = np.empty(2), np.empty(n), np.empty((n, 3)), np.empty(2)
    for depth in range(decisions):
        new_cost = np.full((side, side), np.inf)
        new_at, new_first = np.zeros((side, side, 2)), np.zeros((side, side, 2))
        new_known, new_widths = np.zeros((side, side, n)), np.zeros((side, side, n, 3))
        for a in range(side):
            for b in range(side):
                if cost[a, b] == np.inf:
                    continue
                for east in range(-1, 2):
                    for north in range(-1, 2):
                        if (east != 0 and rate[0] == 0.0) or (north != 0 and rate[1] == 0.0):
                            continue
                        here[:] = at[a, b]
                        seen[:] = known[a, b]
                        width[:] = widths[a, b]
                        total = cost[a, b]
                        for k in range(hold):
                            here[0] = min(max(here[0] + east * rate[0], -limit[0]), limit[0])
                            here[1] = min(max(here[1] + north * rate[1], -limit[1]), limit[1])
                            if depth == 0 and k == 0:
                                begin[:] = here
                            scan = depth * hold + k
                            total += _advanced(here, half, places[scan], weights[scan], seen, width, numbers)
                        x, y = a + east, b + north
                        if total < new_cost[x, y]:
                            new_cost[x, y] = total
                            new_at[x, y] = here
                            new_first[x, y] = begin if depth == 0 else first[a, b]
                            new_known[x, y] = seen
                            new_widths[x, y] = width
        cost, at, first, known, widths = new_cost, new_at, new_first, new_known, new_widths
    best, chosen = np.inf, np.zeros(2)
    for a in range(side):
        for b in range(side):
            if cost[a, b] < best:
                best = cost[a, b]
                chosen[:] = first[a, b]
    return chosen
