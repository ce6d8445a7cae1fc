"""Identities after a crossing: detect and undo an exchange of targets between two chains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np

from servotrack.estimators.sonar.beam_patterns import Patterns, PlanarPatterns
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.directions import LINE, Directions
from servotrack.estimators.sonar.rules import CrossingRules
from servotrack.estimators.types import Array, Labels

T = TypeVar("T")


class _Side(NamedTuple):
    """One target before or after a meeting.

    Attributes:
        at: Rows in which the target exists. Shape (k,).
        bearing: Bearing extrapolated to the middle of the meeting, deg.
        rate: Bearing rate, deg per row.
        log_power: Mean logarithm of the power.
    """

    at: Labels
    bearing: float
    rate: float
    log_power: float


def resolve_crossings(
    chains: list[TrackHypothesis],
    patterns: Patterns | PlanarPatterns,
    rows: Array,
    explained: Sequence[Array],
    beam_bearings: Array,
    rules: CrossingRules,
    directions: Directions = LINE,
) -> bool:
    """Exchange two chains after the first meeting where each fits the other one's continuation better.

    Rates, bearings and powers on both sides of a meeting are compared, and beam patterns where these do not decide.

    Args:
        chains: All chains of a record; two of them are changed.
        patterns: Beam patterns of spectra.
        rows: Normalized beam powers. Shape (T, beams).
        explained: Mean beam powers explained by the other chains, for each chain. Shape (T, beams) each.
        beam_bearings: Bearings of the beams, deg. Shape (beams,).
        rules: Thresholds of the comparison.
        directions: Geometry of the bearings.

    Returns:
        True if two chains were exchanged.
    """
    for i, j in combinations(range(len(chains)), 2):
        one, other = chains[i], chains[j]
        for first, last in _meetings(one, other, rules, directions):
            before = slice(max(0, first - rules.side_rows), first)
            after = slice(last + 1, last + 1 + rules.side_rows)
            middle = 0.5 * (first + last)
            sides = [
                _side(chain, part, middle, rules, directions) for chain in (one, other) for part in (before, after)
            ]
            stay, change = _compare(sides, lambda a, b: _cost(a, b, rules, directions))
            if change < stay + rules.pattern_limit:
                shapes = [
                    None
                    if side is None
                    else _shape(chains[index], side.at, patterns, rows, explained[index], beam_bearings, rules)
                    for index, side in zip((i, i, j, j), sides, strict=True)
                ]
                stay, change = np.add(
                    (stay, change), _compare(shapes, lambda a, b: _cost_of_shape(a, b, rules.pattern_deviation))
                )
            if change + rules.min_gain < stay:
                _exchange(one, other, int(middle) + 1)
                return True
    return False


def _meetings(
    one: TrackHypothesis, other: TrackHypothesis, rules: CrossingRules, directions: Directions
) -> list[tuple[int, int]]:
    both = (one.presence > rules.min_presence) & (other.presence > rules.min_presence)
    near = np.flatnonzero(both & (directions.apart(one.bearings, other.bearings) < rules.meeting_distance))
    if not len(near):
        return []
    breaks = np.flatnonzero(np.diff(near) > rules.pause_rows)
    firsts = np.concatenate([near[:1], near[breaks + 1]])
    lasts = np.concatenate([near[breaks], near[-1:]])
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True)]


def _side(
    chain: TrackHypothesis, part: slice, middle: float, rules: CrossingRules, directions: Directions
) -> _Side | None:
    at = np.arange(len(chain.presence))[part]
    at = at[chain.presence[at] > rules.min_presence]
    if len(at) < rules.min_rows:
        return None
    bearings, centered = directions.unwrapped(chain.bearings[at]), at - at.mean()
    rate = float(centered @ bearings / (centered @ centered))
    log_power = float(np.log(np.maximum(chain.power[at], rules.min_power)).mean())
    return _Side(at, float(bearings.mean() + rate * (middle - at.mean())), rate, log_power)


def _shape(
    chain: TrackHypothesis,
    at: Labels,
    patterns: Patterns | PlanarPatterns,
    rows: Array,
    explained: Array,
    beam_bearings: Array,
    rules: CrossingRules,
) -> Array:
    """Main lobe of the beam pattern fitted to some of a chain's rows."""
    power = np.maximum(chain.power[at], rules.min_power)
    variance = explained[at] ** 2 * rules.pattern_variance
    return patterns.main_lobe(
        patterns.fit(rows[at] - explained[at], variance, beam_bearings, chain.bearings[at], power)
    )


def _compare(sides: Sequence[T | None], cost: Callable[[T, T], float]) -> tuple[float, float]:
    """Costs of keeping and of exchanging the chains; 0 for a missing side."""

    def of(one: int, other: int) -> float:
        a, b = sides[one], sides[other]
        return 0.0 if a is None or b is None else cost(a, b)

    return of(0, 1) + of(2, 3), of(0, 3) + of(2, 1)


def _cost(one: _Side, other: _Side, rules: CrossingRules, directions: Directions) -> float:
    """Half the sum of the squared changes, in standard deviations."""
    changes = (
        (one.rate - other.rate) / rules.rate_deviation,
        float(directions.difference(one.bearing, other.bearing)) / rules.bearing_deviation,
        (one.log_power - other.log_power) / rules.log_power_deviation,
    )
    return 0.5 * float(np.sum(np.square(changes)))


def _cost_of_shape(one: Array, other: Array, deviation: float) -> float:
    return 0.5 * float(np.mean((one - other) ** 2)) / deviation**2


def _exchange(one: TrackHypothesis, other: TrackHypothesis, row: int) -> None:
    for name in ("presence", "bearings", "rates", "deviations", "power", "expected"):
        a, b = getattr(one, name), getattr(other, name)
        if a is not None and b is not None:
            setattr(one, name, np.concatenate([a[:row], b[row:]]))
            setattr(other, name, np.concatenate([b[:row], a[row:]]))
