"""OSPA(2) and trajectory GOSPA: distances between sets of trajectories, including identity errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph

from servotrack.estimators.compilation import njit
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.types import Array
from servotrack.estimators.validation import as_numbers


class TrajectoryGospaParts(NamedTuple):
    """Trajectory GOSPA and its parts; `total ** order` is the sum of the other parts.

    Attributes:
        total: Value of the metric, in the states' unit.
        location: Errors of located targets to the power of `order`, summed over steps.
        missed: `cutoff ** order / 2` for every step of a true track without an estimate.
        false: `cutoff ** order / 2` for every step of an estimated track without a true one.
        switches: `switch_cost ** order` for every full switch of identity, half of it for the start or end of one.
    """

    total: float
    location: float
    missed: float
    false: float
    switches: float


def ospa2(
    truth: ArrayLike,
    estimate: ArrayLike,
    cutoff: float,
    order: float = 1.0,
    distances: Callable[[Array, Array], Array] | None = None,
) -> float:
    """OSPA(2) over the whole time axis (Beard, Vo and Vo, 2020, eqs. 13 and 17, equal weights).

    The base distance of two tracks is the mean distance, limited to `cutoff`, over the steps at which either exists. A
    step at which only one exists counts `cutoff`. The result is the OSPA of the tracks under this base distance.

    Args:
        truth: True tracks, shape (n, T, d), NaN where a track does not exist.
        estimate: Estimated tracks, shape (k, T, d).
        cutoff: Cut-off c of the metric, in the states' unit.
        order: Order p of the OSPA of tracks; the mean over time has order one.
        distances: Base distances of two arrays of states, (*batch, n, d) and (*batch, k, d) to (*batch, n, k); None:
            Euclidean.

    Returns:
        Distance from 0 to `cutoff`.

    Raises:
        ValueError: Shapes disagree, the cut-off is not positive, or the order is below 1.
    """
    a, b = _check(truth, estimate, cutoff, order)
    n, k = len(a), len(b)
    low, high = min(n, k), max(n, k)
    if high == 0:
        return 0.0
    total = cutoff**order * (high - low)
    if low > 0:
        base = _track_distances(a, b, cutoff) if distances is None else _general_distances(a, b, cutoff, distances)
        base = base**order
        cost = np.ascontiguousarray(base if n <= k else base.T)
        total += float(cost[np.arange(low), assign(cost, low, high)].sum())
    return (total / high) ** (1.0 / order)


def trajectory_gospa(
    truth: ArrayLike, estimate: ArrayLike, cutoff: float, switch_cost: float, order: float = 1.0
) -> TrajectoryGospaParts:
    """Trajectory GOSPA by linear programming (Garcia-Fernandez, Rahmathullah and Svensson, 2020, eq. 23), alpha = 2.

    Pairs of tracks that never come within the cut-off cannot lower the cost and have no variable. The remaining pairs
    split into independent programs.

    Args:
        truth: True tracks, shape (n, T, d), NaN where a track does not exist.
        estimate: Estimated tracks, shape (k, T, d).
        cutoff: Cut-off c of the metric, in the states' unit.
        switch_cost: Cost gamma of a switch of identity, in the states' unit.
        order: Order p of the metric.

    Raises:
        ValueError: Shapes disagree, the cut-off or switch cost is not positive, or the order is below 1.
    """
    a, b = _check(truth, estimate, cutoff, order)
    if not (math.isfinite(switch_cost) and switch_cost > 0.0):
        raise ValueError(f"switch_cost must be positive and finite, got {switch_cost!r}")
    full = cutoff**order
    exist_a, exist_b = ~np.isnan(a[..., 0]), ~np.isnan(b[..., 0])
    errors = _cut_distances(a, b, cutoff) ** order
    located = errors < full
    weights = _assignment_weights(np.where(located, errors - full, 0.0), switch_cost**order)
    location = float((weights * np.where(located, errors, 0.0)).sum())
    matched = float((weights * located).sum())
    missed, false = 0.5 * full * (exist_a.sum() - matched), 0.5 * full * (exist_b.sum() - matched)
    switches = 0.5 * switch_cost**order * float(np.abs(np.diff(weights, axis=2)).sum())
    total = (location + missed + false + switches) ** (1.0 / order)
    return TrajectoryGospaParts(float(total), location, float(missed), float(false), switches)


def _check(truth: ArrayLike, estimate: ArrayLike, cutoff: float, order: float) -> tuple[Array, Array]:
    a, b = as_numbers("truth", truth), as_numbers("estimate", estimate)
    if a.ndim != 3 or b.ndim != 3 or a.shape[1:] != b.shape[1:]:
        raise ValueError(
            f"truth and estimate must have shapes (n, T, d) and (k, T, d), got {a.shape} and {b.shape}; "
            "stack_tracks makes them from lists of tracks"
        )
    if not (math.isfinite(cutoff) and cutoff > 0.0):
        raise ValueError(f"cutoff must be positive and finite, got {cutoff!r}")
    if not (math.isfinite(order) and order >= 1.0):
        raise ValueError(f"order must be finite and at least 1, got {order!r}")
    return _existing(a), _existing(b)


@njit(cache=True, nogil=True)
def _existing(tracks):  # type: ignore[no-untyped-def]
    """Keep the tracks that exist at some step, with NaN in all numbers of a state or in none."""
    count, steps, size = tracks.shape
    out, kept = np.full(tracks.shape, np.nan), 0
    for i in range(count):
        found = False
        for t in range(steps):
            here = True
            for axis in range(size):
                here &= not math.isnan(tracks[i, t, axis])
            if here:
                found = True
                for axis in range(size):
                    out[kept, t, axis] = tracks[i, t, axis]
        kept += found
    return out[:kept]


def _assignment_weights(gain: Array, switch_cost: float) -> Array:
    """Optimal soft assignments W of the metric's linear program.

    Args:
        gain: Change of the cost by assigning a pair at a step, at most 0. Shape (n, k, T).
        switch_cost: Cost of a change of W by two, gamma to the power of p.

    Returns:
        Weights from 0 to 1. Shape (n, k, T).
    """
    n, k, steps = gain.shape
    weights = np.zeros_like(gain)
    ever = (gain < 0.0).any(axis=2)
    links = sparse.coo_array(ever)
    graph = sparse.coo_array((np.ones(links.nnz), (links.row, n + links.col)), shape=(n + k, n + k))
    _, group = csgraph.connected_components(graph, directed=False)
    for label in np.unique(group[links.row]):
        rows, columns = np.nonzero(ever & (group[:n, None] == label))
        if len(rows) == 1:
            weights[rows[0], columns[0]] = 1.0
            continue
        useful = np.flatnonzero((gain[rows, columns] < 0.0).any(axis=0))
        solved = _solve_program(gain[rows, columns][:, useful], rows, columns, switch_cost)
        # At steps without gain the previous assignment stays, which avoids switches.
        latest = np.clip(np.searchsorted(useful, np.arange(steps), side="right") - 1, 0, None)
        weights[rows, columns] = solved[:, latest]
    return weights


def _solve_program(gain: Array, rows: NDArray[np.intp], columns: NDArray[np.intp], switch_cost: float) -> Array:
    """Solve the linear program of one group of pairs; gain and result have shape (pairs, steps)."""
    from scipy.optimize import linprog

    pairs, steps = gain.shape
    size, changes = pairs * steps, pairs * (steps - 1)
    index = np.arange(size).reshape(pairs, steps)
    # A track belongs to at most one pair per step.
    row_number = np.unique(rows, return_inverse=True)[1]
    column_number = np.unique(columns, return_inverse=True)[1]
    owners = np.concatenate([row_number, row_number.max() + 1 + column_number])
    capacity_rows = (owners[:, None] * steps + np.arange(steps)).ravel()
    capacity = sparse.coo_array(
        (np.ones(2 * size), (capacity_rows, np.concatenate([index.ravel(), index.ravel()]))),
        shape=((owners.max() + 1) * steps, size + changes),
    )
    # One variable per change of W bounds its absolute value.
    number = np.arange(changes)
    after, before = index[:, 1:].ravel(), index[:, :-1].ravel()
    one = np.ones(changes)
    blocks = [
        sparse.coo_array(
            (
                np.concatenate([sign * one, -sign * one, -one]),
                (np.concatenate([number] * 3), np.concatenate([after, before, size + number])),
            ),
            shape=(changes, size + changes),
        )
        for sign in (1.0, -1.0)
    ]
    limits = np.concatenate([np.ones(capacity.shape[0]), np.zeros(2 * changes)])
    price = np.concatenate([gain.ravel(), np.full(changes, 0.5 * switch_cost)])
    found = linprog(price, A_ub=sparse.vstack([capacity, *blocks], format="csr"), b_ub=limits, method="highs")
    if found.x is None:
        raise ArithmeticError(f"the linear program of trajectory GOSPA was not solved: {found.message}")
    return found.x[:size].reshape(pairs, steps)


def _general_distances(a: Array, b: Array, cutoff: float, distances: Callable[[Array, Array], Array]) -> Array:
    """Mean distance of tracks as in `_track_distances`, under any base distance. Shape (n, k)."""
    exist_a, exist_b = ~np.isnan(a[..., 0]), ~np.isnan(b[..., 0])
    here = np.where(exist_b[..., None], b, 0.0)
    out = np.empty((len(a), len(b)))
    for i, track in enumerate(a):
        at = exist_a[i]
        both = exist_b[:, at]
        apart = np.minimum(distances(track[at][:, None], here[:, at].swapaxes(0, 1))[:, 0].T, cutoff)
        either = (exist_a[i] | exist_b).sum(axis=1)
        out[i] = (np.where(both, apart, 0.0).sum(axis=1) + cutoff * (either - both.sum(axis=1))) / either
    return out


@njit(cache=True, nogil=True)
def _cut_distances(a, b, cutoff):  # type: ignore[no-untyped-def]
    """Distances limited to the cut-off, and the cut-off where either track does not exist; shape (n, k, T)."""
    out = np.full((a.shape[0], b.shape[0], a.shape[1]), cutoff)
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            for t in range(a.shape[1]):
                squared = 0.0
                for axis in range(a.shape[2]):
                    squared += (a[i, t, axis] - b[j, t, axis]) ** 2
                # False for NaN.
                if squared < cutoff * cutoff:
                    out[i, j, t] = math.sqrt(squared)
    return out


@njit(cache=True, nogil=True)
def _track_distances(a, b, cutoff):  # type: ignore[no-untyped-def]
    """Mean limited distance over the steps at which either track exists, shape (n, k).

    The innermost loops run over all tracks of `b` side by side, which the compiler turns into vector instructions.
    """
    count, steps, size = b.shape
    others, present = np.empty((steps, size, count)), np.empty((steps, count))
    for j in range(count):
        for t in range(steps):
            present[t, j] = 0.0 if math.isnan(b[j, t, 0]) else 1.0
            for axis in range(size):
                others[t, axis, j] = b[j, t, axis]
    out, squared, counted = np.empty((a.shape[0], count)), np.empty(count), np.empty(count)
    for i in range(a.shape[0]):
        out[i] = 0.0
        counted[:] = 0.0
        for t in range(steps):
            if math.isnan(a[i, t, 0]):
                for j in range(count):
                    out[i, j] += cutoff * present[t, j]
                    counted[j] += present[t, j]
                continue
            squared[:] = 0.0
            for axis in range(size):
                here = a[i, t, axis]
                for j in range(count):
                    squared[j] += (here - others[t, axis, j]) ** 2
            for j in range(count):
                # False for NaN.
                out[i, j] += math.sqrt(squared[j]) if squared[j] < cutoff * cutoff else cutoff
                counted[j] += 1.0
        for j in range(count):
            out[i, j] /= counted[j]
    return out
