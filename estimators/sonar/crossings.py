"""Who is who after a meeting: each of two chains may follow one target up to it and the other one from there on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np

from servotrack.estimators.sonar.beam_patterns import Patterns
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.types import Array, Labels

T = TypeVar("T")

NEAR = 0.08
"""Difference of cosines below which two targets meet."""
PAUSE = 3
"""Rows of distance that do not end a meeting."""
SIDE = 10
"""Rows before and after a meeting that are compared."""
LEAST = 3
"""Rows from which a side is judged."""
THERE = 0.3
RATE, PLACE, LEVEL, SHAPE = 0.2, 1.0, 0.3, 0.15
"""Standard deviations of one target's changes over a meeting: rate (deg/s), bearing in its middle (deg), logarithm of
its power, and root mean square of its pattern."""
PLAIN = 30.0
"""By how much exchanging may be less likely before patterns are compared, nats."""
LEAST_POWER, VARIANCE = 1e-3, 1e-3
"""Below which a power does not count; of beam powers, where patterns are compared."""
BETTER = 1.0
"""By how much exchanging must be more likely, nats."""


class _Side(NamedTuple):
    """One target before or after a meeting: its rows, bearing carried to the middle, rate, log power."""

    at: Labels
    place: float
    rate: float
    level: float


def resolve_crossings(
    chains: list[TrackHypothesis], patterns: Patterns, rows: Array, explained: Sequence[Array], looks: Array
) -> bool:
    """Exchange the rest of two chains after the first meeting where that makes them more like themselves.

    Args:
        chains: All chains of a record; two of them are changed.
        patterns: Of spectra.
        rows: Normalized beam powers. Shape (T, beams).
        explained: For each chain what the others explain. Shape (T, beams) each.
        looks: Bearings of the beams, deg. Shape (beams,).

    Returns:
        Whether there was such a meeting.
    """
    for i, j in combinations(range(len(chains)), 2):
        one, other = chains[i], chains[j]
        for first, last in _meetings(one, other):
            before = slice(max(0, first - SIDE), first)
            after = slice(last + 1, last + 1 + SIDE)
            middle = 0.5 * (first + last)
            sides = [_side(chain, part, middle) for chain in (one, other) for part in (before, after)]
            stay, change = _compare(sides, _cost)
            if change < stay + PLAIN:
                shapes = [
                    None if side is None else _shape(chains[index], side.at, patterns, rows, explained[index], looks)
                    for index, side in zip((i, i, j, j), sides, strict=True)
                ]
                stay, change = np.add((stay, change), _compare(shapes, _cost_of_shape))
            if change + BETTER < stay:
                _exchange(one, other, int(middle) + 1)
                return True
    return False


def _meetings(one: TrackHypothesis, other: TrackHypothesis) -> list[tuple[int, int]]:
    both = (one.presence > THERE) & (other.presence > THERE)
    apart = np.abs(np.cos(np.radians(one.bearings)) - np.cos(np.radians(other.bearings)))
    near = np.flatnonzero(both & (apart < NEAR))
    if not len(near):
        return []
    breaks = np.flatnonzero(np.diff(near) > PAUSE)
    firsts = np.concatenate([near[:1], near[breaks + 1]])
    lasts = np.concatenate([near[breaks], near[-1:]])
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True)]


def _side(chain: TrackHypothesis, part: slice, middle: float) -> _Side | None:
    at = np.arange(len(chain.presence))[part]
    at = at[chain.presence[at] > THERE]
    if len(at) < LEAST:
        return None
    bearings, centered = chain.bearings[at], at - at.mean()
    rate = float(centered @ bearings / (centered @ centered))
    level = float(np.log(np.maximum(chain.power[at], LEAST_POWER)).mean())
    return _Side(at, float(bearings.mean() + rate * (middle - at.mean())), rate, level)


def _shape(
    chain: TrackHypothesis, at: Labels, patterns: Patterns, rows: Array, explained: Array, looks: Array
) -> Array:
    """Pattern that fits some of a chain's rows."""
    power = np.maximum(chain.power[at], LEAST_POWER)
    cosines = np.cos(np.radians(looks))
    variance = explained[at] ** 2 * VARIANCE
    return patterns.main_lobe(patterns.fit(rows[at] - explained[at], variance, cosines, chain.bearings[at], power))


def _compare(sides: Sequence[T | None], cost: Callable[[T, T], float]) -> tuple[float, float]:
    """Cost of staying and of exchanging; nothing where a side is missing."""

    def of(one: int, other: int) -> float:
        a, b = sides[one], sides[other]
        return 0.0 if a is None or b is None else cost(a, b)

    return of(0, 1) + of(2, 3), of(0, 3) + of(2, 1)


def _cost(one: _Side, other: _Side) -> float:
    """Half the squared changes in standard deviations."""
    changes = (one.rate - other.rate) / RATE, (one.place - other.place) / PLACE, (one.level - other.level) / LEVEL
    return 0.5 * float(np.sum(np.square(changes)))


def _cost_of_shape(one: Array, other: Array) -> float:
    return 0.5 * float(np.mean((one - other) ** 2)) / SHAPE**2


def _exchange(one: TrackHypothesis, other: TrackHypothesis, row: int) -> None:
    for name in ("presence", "bearings", "rates", "deviations", "power", "expected"):
        a, b = getattr(one, name), getattr(other, name)
        if a is not None and b is not None:
            setattr(one, name, np.concatenate([a[:row], b[row:]]))
            setattr(other, name, np.concatenate([b[:row], a[row:]]))
