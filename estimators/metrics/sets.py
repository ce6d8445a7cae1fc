"""OSPA and GOSPA between finite sets, in batches, from one assignment."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import point_distances
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import as_numbers


class GospaParts(NamedTuple):
    """GOSPA (alpha = 2) and its parts; `total ** order = location + missed + false`.

    Attributes:
        total: Value of the metric. Shape (*batch,), in the distances' unit.
        location: Sum of the located targets' errors to the power of `order`. Shape (*batch,).
        missed: `cutoff ** order / 2` for every truth without an estimate. Shape (*batch,).
        false: `cutoff ** order / 2` for every estimate without a truth. Shape (*batch,).
    """

    total: Array
    location: Array
    missed: Array
    false: Array


class SetScores(NamedTuple):
    """All set distances between a truth and an estimate.

    Attributes:
        ospa: OSPA distance. Shape (*batch,), in the distances' unit.
        gospa: GOSPA distance with its three parts.
        cardinality_error: Number of estimates minus number of truths. Shape (*batch,), int.
    """

    ospa: Array
    gospa: GospaParts
    cardinality_error: Labels


def score_distances(
    distances: ArrayLike, truth_exists: ArrayLike, estimate_exists: ArrayLike, cutoff: float, order: float = 1.0
) -> SetScores:
    """OSPA (Schuhmacher, Vo and Vo, 2008, eq. 3) and GOSPA (Rahmathullah et al., 2017, eq. 1 and prop. 1) at once.

    With alpha = 2 an assigned pair beyond the cut-off costs as much as one missed and one false target, so both metrics
    have the same optimal assignment.

    Args:
        distances: Base distances between truths and estimates, shape (*batch, n, k). Values of members that do
            not exist are ignored.
        truth_exists: Mask of the truths that exist, shape (*batch, n), bool.
        estimate_exists: Mask of the estimates that exist, shape (*batch, k), bool.
        cutoff: Cut-off distance c, positive: a pair farther apart counts as one missed and one false target.
        order: Order p of the metrics, at least 1. Larger values weigh large errors more.

    Raises:
        ValueError: The cut-off, the order or a shape is invalid, or a distance between existing members is NaN.
    """
    if not (math.isfinite(cutoff) and cutoff > 0.0):
        raise ValueError(f"cutoff must be positive and finite, got {cutoff!r}")
    if not (math.isfinite(order) and order >= 1.0):
        raise ValueError(f"order must be finite and at least 1, got {order!r}")
    matrix = as_numbers("distances", distances)
    truths, estimates = np.asarray(truth_exists, dtype=np.bool_), np.asarray(estimate_exists, dtype=np.bool_)
    if (
        matrix.ndim < 2
        or truths.shape != matrix.shape[:-1]
        or estimates.shape != (*matrix.shape[:-2], matrix.shape[-1])
    ):
        raise ValueError(
            "distances, truth_exists and estimate_exists must have shapes (*batch, n, k), (*batch, n) and (*batch, k), "
            f"got {matrix.shape}, {truths.shape} and {estimates.shape}"
        )
    batch, (n, k) = matrix.shape[:-2], matrix.shape[-2:]
    rows = math.prod(batch)
    out = np.zeros((rows, 6))
    if not _score(matrix.reshape(rows, n, k), truths.reshape(rows, n), estimates.reshape(rows, k), cutoff, order, out):
        raise ValueError(
            "distances between existing members must not be NaN; drop or repair members that are not finite"
        )
    ospa_, total, location, missed, false, cardinality = (out[:, i].reshape(batch).copy() for i in range(6))
    return SetScores(ospa_, GospaParts(total, location, missed, false), cardinality.astype(np.int64))


def score_points(
    truth: ArrayLike,
    estimate: ArrayLike,
    cutoff: float,
    order: float = 1.0,
    truth_exists: ArrayLike | None = None,
    estimate_exists: ArrayLike | None = None,
) -> SetScores:
    """`score_distances` for points under the Euclidean distance.

    Args:
        truth: True points, shape (*batch, n, d).
        estimate: Estimated points, shape (*batch, k, d).
        cutoff: Cut-off c of the metrics, in the points' unit.
        order: Order p of the metrics.
        truth_exists: Mask of the truths that exist, shape (*batch, n), bool; None: all.
        estimate_exists: Mask of the estimates that exist, shape (*batch, k), bool; None: all.

    Raises:
        ValueError: As `score_distances`, or if points differ in dimension.
    """
    a, b = as_numbers("truth", truth), as_numbers("estimate", estimate)
    distances = point_distances(a, b)
    truths = np.ones(distances.shape[:-1], np.bool_) if truth_exists is None else truth_exists
    estimates = np.ones((*distances.shape[:-2], b.shape[-2]), np.bool_) if estimate_exists is None else estimate_exists
    return score_distances(distances, truths, estimates, cutoff, order)


def ospa(truth: ArrayLike, estimate: ArrayLike, cutoff: float, order: float = 1.0) -> Array:
    """Optimal subpattern assignment distance of point sets; 0 between empty sets, `cutoff` if one is empty.

    Args:
        truth: True points, shape (*batch, n, d).
        estimate: Estimated points, shape (*batch, k, d).
        cutoff: Cut-off c of the metric, in the points' unit.
        order: Order p of the metric.

    Returns:
        Distance, shape (*batch,), in the points' unit.

    Raises:
        ValueError: As `score_points`.
    """
    return score_points(truth, estimate, cutoff, order).ospa


def gospa(truth: ArrayLike, estimate: ArrayLike, cutoff: float, order: float = 1.0) -> GospaParts:
    """Generalized OSPA (alpha = 2) of point sets with its parts; arguments and errors as in `ospa`."""
    return score_points(truth, estimate, cutoff, order).gospa


@njit(cache=True, nogil=True)
def _score(distances, truths, estimates, cutoff, order, out):  # type: ignore[no-untyped-def]
    """Fill (ospa, gospa, location, missed, false, cardinality error) of every row; return False for a NaN."""
    count, n_max, k_max = distances.shape
    small = min(n_max, k_max)
    cost = np.empty((small, max(n_max, k_max)))
    truth_rows = np.empty(n_max, np.int64)
    estimate_rows = np.empty(k_max, np.int64)
    for row in range(count):
        n, k = 0, 0
        for i in range(n_max):
            if truths[row, i]:
                truth_rows[n] = i
                n += 1
        for j in range(k_max):
            if estimates[row, j]:
                estimate_rows[k] = j
                k += 1
        low, high = min(n, k), max(n, k)
        for i in range(n):
            for j in range(k):
                distance = distances[row, truth_rows[i], estimate_rows[j]]
                if math.isnan(distance):
                    return False
                cut = min(distance, cutoff)
                if order != 1.0:
                    cut **= order
                if n <= k:
                    cost[i, j] = cut
                else:
                    cost[j, i] = cut
        full = cutoff**order
        assigned, location, located = 0.0, 0.0, 0
        if low > 0:
            chosen = assign(cost, low, high)
            for i in range(low):
                value = cost[i, chosen[i]]
                assigned += value
                if value < full:
                    location += value
                    located += 1
        missed, false = 0.5 * full * (n - located), 0.5 * full * (k - located)
        out[row, 0] = ((assigned + full * (high - low)) / high) ** (1.0 / order) if high > 0 else 0.0
        out[row, 1] = (location + missed + false) ** (1.0 / order)
        out[row, 2] = location
        out[row, 3] = missed
        out[row, 4] = false
        out[row, 5] = k - n
    return True
