"""Who is who after a meeting: each of two chains may follow one target up to it and the other one from there on."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.sonar.explained import Patterns
from servotrack.estimators.sonar.followed import Followed

Array = NDArray[np.float64]

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
BETTER = 1.0
"""By how much exchanging must be more likely, nats."""


class _Side(NamedTuple):
    """One target before or after a meeting: bearing carried to the middle, rate, log power, pattern."""

    place: float
    rate: float
    level: float
    shape: Array


def untangle(chains: list[Followed], patterns: Patterns, rows: Array, explained: Sequence[Array], looks: Array) -> bool:
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
            sides = [
                _side(chain, part, middle, patterns, rows, explained[index], looks)
                for index, chain in ((i, one), (j, other))
                for part in (before, after)
            ]
            stay = _cost(sides[0], sides[1]) + _cost(sides[2], sides[3])
            change = _cost(sides[0], sides[3]) + _cost(sides[2], sides[1])
            if change + BETTER < stay:
                _exchange(one, other, int(middle) + 1)
                return True
    return False


def _meetings(one: Followed, other: Followed) -> list[tuple[int, int]]:
    both = (one.presence > THERE) & (other.presence > THERE)
    apart = np.abs(np.cos(np.radians(one.bearings)) - np.cos(np.radians(other.bearings)))
    near = np.flatnonzero(both & (apart < NEAR))
    if not len(near):
        return []
    breaks = np.flatnonzero(np.diff(near) > PAUSE)
    firsts = np.concatenate([near[:1], near[breaks + 1]])
    lasts = np.concatenate([near[breaks], near[-1:]])
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True)]


def _side(
    chain: Followed, part: slice, middle: float, patterns: Patterns, rows: Array, explained: Array, looks: Array
) -> _Side | None:
    at = np.arange(len(chain.presence))[part]
    at = at[chain.presence[at] > THERE]
    if len(at) < LEAST:
        return None
    bearings = chain.bearings[at]
    rate = float(np.polyfit(at, bearings, 1)[0]) if len(at) > LEAST else float(chain.rates[at].mean())
    place = float(bearings.mean() + rate * (middle - at.mean()))
    power = np.maximum(chain.power[at], 1e-3)
    excess = rows[at] - explained[at]
    cosines = np.cos(np.radians(looks))
    mixture = patterns.fit(excess, explained[at] ** 2 / 1000.0, cosines, bearings, power)
    return _Side(place, rate, float(np.log(power).mean()), patterns.main_lobe(mixture))


def _cost(one: _Side | None, other: _Side | None) -> float:
    """Half the squared changes in standard deviations; nothing where a side is missing."""
    if one is None or other is None:
        return 0.0
    changes = (
        (one.rate - other.rate) / RATE,
        (one.place - other.place) / PLACE,
        (one.level - other.level) / LEVEL,
        float(np.sqrt(np.mean((one.shape - other.shape) ** 2))) / SHAPE,
    )
    return 0.5 * float(np.sum(np.square(changes)))


def _exchange(one: Followed, other: Followed, row: int) -> None:
    for name in ("presence", "bearings", "rates", "deviations", "power", "expected"):
        a, b = getattr(one, name), getattr(other, name)
        if a is not None and b is not None:
            setattr(one, name, np.concatenate([a[:row], b[row:]]))
            setattr(other, name, np.concatenate([b[:row], a[row:]]))
