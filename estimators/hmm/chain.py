"""Markov chains over many states whose transitions are runs of shifted additions.

A run adds `weight` times the probabilities of `length` neighboring states to the same number of neighboring states
elsewhere. On a grid of positions and rates, one run moves all positions of one rate to another rate. A sparse matrix
consists of runs of length one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, sparray, spmatrix

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels


class Runs(NamedTuple):
    """Transitions of a chain.

    Attributes:
        source: First source state of each run. Shape (runs,).
        target: First target state of each run. Shape (runs,).
        length: Number of neighboring states in each run. Shape (runs,).
        weight: Transition probability of each run. Shape (runs,).
    """

    source: Labels
    target: Labels
    length: Labels
    weight: Array


@dataclass(frozen=True, eq=False)
class Chain:
    """A Markov chain.

    Attributes:
        states: Number S of states.
        runs: Transitions, as `grid_chain` and `sparse_chain` make them.
    """

    states: int
    runs: Runs

    def predict(self, probabilities: ArrayLike) -> Array:
        """Predict probabilities one step ahead; probability that leaves the grid is lost. Shape (S,)."""
        p = np.ascontiguousarray(probabilities, np.float64)
        if p.shape != (self.states,):
            raise ValueError(f"probabilities must have shape ({self.states},), got {p.shape}")
        out = np.empty(self.states)
        predict_into(self.runs, p, out)
        return out

    def uniform(self) -> Array:
        """Return the same probability for all states. Shape (S,)."""
        return np.full(self.states, 1.0 / self.states)


@dataclass(frozen=True, eq=False)
class GridChain(Chain):
    """Markov chain over positions and rates; state r * positions + i is rate r at position i.

    Attributes:
        positions: Number P of positions.
        rates: Rates, per second. Shape (R,).
        spacing: Distance of neighboring positions.
        period: Time of one step, s.
    """

    positions: int
    rates: Array
    spacing: float
    period: float


def grid_chain(
    positions: int,
    rates: ArrayLike,
    spacing: float,
    period: float = 1.0,
    acceleration: float = 0.3,
    least_weight: float = 1e-5,
    circular: bool = False,
) -> GridChain:
    """Markov chain of a nearly constant rate on a grid: x' = x + (r + r') / 2 period, r' Gaussian about r.

    The noise of the constant-rate model has rank one, so the change of rate determines the position. With rates in
    steps of 2 spacing / period (or whole multiples of it) every step ends on the grid.

    Args:
        positions: Number P of positions.
        rates: Equally spaced rates, per second. Shape (R,).
        spacing: Distance of neighboring positions.
        period: Time of one step, s.
        acceleration: Standard deviation of the acceleration, per second squared. Larger values allow faster maneuvers
            and average fewer rows.
        least_weight: Transition probability below which a transition is omitted. Larger values are faster and less
            exact.
        circular: The position after the last one is the first.

    Raises:
        ValueError: The rates do not fit the grid; the message gives a spacing that does.
    """
    r = np.atleast_1d(np.asarray(rates, np.float64))
    if positions < 2:
        raise ValueError(f"positions must be at least 2, got {positions!r}")
    for name, value in (("spacing", spacing), ("period", period), ("acceleration", acceleration)):
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} must be positive, got {value!r}")
    cells = _cells_of_rates(r, spacing, period)
    weight = np.exp(-(np.subtract.outer(r, r) ** 2) / (2.0 * (acceleration * period) ** 2))
    weight /= weight.sum(axis=1, keepdims=True)
    weight[weight < least_weight] = 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    before, after = np.nonzero(weight)
    shift = (cells[before] + cells[after]) // 2
    reachable = np.abs(shift) < positions
    before, after, shift = before[reachable], after[reachable], shift[reachable]
    source = before * positions + np.maximum(-shift, 0)
    target = after * positions + np.maximum(shift, 0)
    runs = Runs(source, target, positions - np.abs(shift), weight[before, after])
    if circular:
        # What leaves at one end enters at the other.
        over = shift != 0
        some = shift[over]
        source = before[over] * positions + np.where(some > 0, positions - some, 0)
        target = after[over] * positions + np.where(some > 0, 0, positions + some)
        runs = Runs(
            np.concatenate([runs.source, source]),
            np.concatenate([runs.target, target]),
            np.concatenate([runs.length, np.abs(some)]),
            np.concatenate([runs.weight, runs.weight[over]]),
        )
    return GridChain(positions * len(r), runs, positions, r, spacing, period)


def sparse_chain(transitions: ArrayLike | sparray | spmatrix) -> Chain:
    """Make a chain from its transition probabilities.

    Args:
        transitions: Probability of each state (column) after each state (row); dense or scipy.sparse. Shape (S, S).

    Raises:
        ValueError: The matrix is not square, or a row does not hold probabilities with a sum of at most 1.
    """
    matrix = coo_array(transitions)  # type: ignore[arg-type]  # SciPy's stubs omit nested lists
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"transitions must be square, got shape {matrix.shape}")
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    if not (np.isfinite(matrix.data).all() and (matrix.data >= 0.0).all() and (sums <= 1.0 + 1e-9).all()):
        raise ValueError(
            "transitions must be probabilities whose rows sum to at most 1, "
            f"got entries from {matrix.data.min():g} and rows up to {sums.max():g}"
        )
    row, column = (np.asarray(index, np.int64) for index in matrix.coords)
    runs = Runs(row, column, np.ones(len(row), np.int64), np.asarray(matrix.data, np.float64))
    return Chain(int(matrix.shape[0]), runs)


def _cells_of_rates(rates: Array, spacing: float, period: float) -> Labels:
    """Cells per step for each rate: whole numbers with even differences."""
    if not np.isfinite(rates).all():
        raise ValueError(f"rates must be finite, got {rates.tolist()}")
    step = float(rates[1] - rates[0]) if len(rates) > 1 else 2.0 * spacing / period
    if len(rates) > 1 and (step <= 0.0 or not np.allclose(np.diff(rates), step, rtol=1e-9, atol=0.0)):
        raise ValueError(f"rates must rise in equal steps, got {rates.tolist()}")
    exact = rates * period / spacing
    cells = np.rint(exact).astype(np.int64)
    if np.abs(exact - cells).max() > 1e-6 or np.any(np.diff(cells) % 2):
        raise ValueError(
            f"rates in steps of {step:g} do not fit positions {spacing:g} apart with a period of {period:g} s: choose "
            f"spacing={step * period / 2.0:g} or a whole fraction of it with rates at multiples of their step, or "
            f"rates at multiples of {2.0 * spacing / period:g}"
        )
    return cells


@njit(cache=True, nogil=True)
def predict_into(runs, probabilities, out):  # type: ignore[no-untyped-def]
    """Forward step: out[j] = sum_i probabilities[i] a_ij."""
    out[:] = 0.0
    for run in range(runs.source.shape[0]):
        weight, length = runs.weight[run], runs.length[run]
        source = probabilities[runs.source[run] : runs.source[run] + length]
        target = out[runs.target[run] : runs.target[run] + length]
        for i in range(length):
            target[i] += weight * source[i]


@njit(cache=True, nogil=True)
def reach_of_band(runs, width, low, high):  # type: ignore[no-untyped-def]
    """Band of the targets, modulo `width`, of runs whose source modulo `width` lies in low to high - 1."""
    lowest, highest = width, 0
    for run in range(runs.source.shape[0]):
        first = runs.source[run] % width
        start, stop = max(low, first), min(high, first + runs.length[run])
        if start < stop:
            shift = runs.target[run] % width - first
            lowest, highest = min(lowest, start + shift), max(highest, stop + shift)
    return lowest, highest


@njit(cache=True, nogil=True)
def step_band(runs, read, write, values, width, low, high, out):  # type: ignore[no-untyped-def]
    """Add one step along the runs, from states whose index modulo `width` lies in low to high - 1, to `out`.

    With `read` the sources and `write` the targets of the runs, this is `predict_into`. Exchanged, it is the backward
    step out[i] = sum_j a_ij values[j] of the states i in the band.
    """
    for run in range(runs.source.shape[0]):
        first = runs.source[run] % width
        skip = max(low - first, 0)
        length = min(high - first, runs.length[run]) - skip
        if length > 0:
            weight = runs.weight[run]
            source = values[read[run] + skip : read[run] + skip + length]
            target = out[write[run] + skip : write[run] + skip + length]
            for i in range(length):
                target[i] += weight * source[i]
