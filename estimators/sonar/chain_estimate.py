"""Hypothesis of one target in a record: bearings, power, beam pattern and span of existence of one chain."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from servotrack.estimators.hmm.existence import Span, presence, spans
from servotrack.estimators.sonar.directions import LINE, Directions
from servotrack.estimators.sonar.rules import SpanRules
from servotrack.estimators.types import Array, Labels


@dataclass(eq=False)
class TrackHypothesis:
    """Estimates of one chain's target, row by row.

    Attributes:
        presence: Probability that the target exists. Shape (T,).
        mixture: Spectrum of the target, as a mixture of `Patterns`.
        bearings: Bearing of the target, deg. Shape (T,).
        rates: Bearing rate, deg/s. Shape (T,).
        deviations: Standard deviation of the bearing, deg. Shape (T,).
        power: Power above the noise in the beam towards the target. Shape (T,).
        expected: Power expected from the surrounding rows; None before the first fit. Shape (T,).
        pattern: Beam pattern of the target, peak 1. Shape (T, beams).
        existence_likelihood: Existence likelihood Lam_k of each row. Shape (T,).
        likelihood: Likelihood ratios of the rows under the positions or states, in the last sweep. Shape (T, W).
        marginal: Probabilities of the states, kept only where other chains need them. Shape (T, S).
        spans: Spans of rows in which the target exists.
        evidence: Log likelihood ratio of each span, nats.
        label: Identity; 0 before one is assigned.
        prior: Probabilities of the states at the first row; None: uniform. Shape (S,).
        period: Time between rows, s.
        prior_presence: Probability of existence at the first row.
    """

    presence: Array
    mixture: Array
    bearings: Array = field(default_factory=lambda: np.zeros(0))
    rates: Array = field(default_factory=lambda: np.zeros(0))
    deviations: Array = field(default_factory=lambda: np.zeros(0))
    power: Array = field(default_factory=lambda: np.zeros(0))
    expected: Array | None = None
    pattern: Array = field(default_factory=lambda: np.zeros((0, 0)))
    existence_likelihood: Array = field(default_factory=lambda: np.zeros(0))
    likelihood: Array = field(default_factory=lambda: np.zeros((0, 0)))
    marginal: Array = field(default_factory=lambda: np.zeros((0, 0)))
    spans: list[Span] = field(default_factory=list)
    evidence: list[float] = field(default_factory=list)
    label: int = 0
    prior: Array | None = None
    period: float = 1.0
    prior_presence: float = 0.5

    def locate(
        self, marginal: Array, grid_bearings: Array, rates: Array, mode_width: float, directions: Directions = LINE
    ) -> None:
        """Set bearings, rates and deviations from the probabilities of all states.

        Args:
            marginal: Probabilities of the states. Shape (T, S).
            grid_bearings: Bearings of the grid, deg. Shape (positions,).
            rates: Bearing rates of the grid, deg/s. Shape (R,).
            mode_width: Half-width of the window around the mode over which is averaged, deg.
            directions: Geometry of the bearings.
        """
        size = len(grid_bearings)
        cells = marginal.reshape(len(marginal), len(rates), size)
        positions = cells.sum(axis=1)
        spacing = grid_bearings[1] - grid_bearings[0]
        half = min(round(mode_width / spacing), (size - 1) // 2)
        index = positions.argmax(axis=1)[:, None] + np.arange(-half, half + 1)
        inside = (index >= 0) & (index < size) | directions.circle
        near = grid_bearings[0] + spacing * index if directions.circle else grid_bearings[np.clip(index, 0, size - 1)]
        index = index % size if directions.circle else np.clip(index, 0, size - 1)
        weight = np.take_along_axis(positions, index, axis=1) * inside
        weight /= weight.sum(axis=1, keepdims=True)
        self.bearings = (weight * near).sum(axis=1)
        self.deviations = np.sqrt((weight * (near - self.bearings[:, None]) ** 2).sum(axis=1))
        self.bearings = directions.wrapped(self.bearings)
        self.rates = np.einsum("trp,r->t", cells, rates)

    def test_existence(
        self,
        switching: float,
        bridge: int,
        piece: float,
        whole: float,
        max_step: float,
        rules: SpanRules,
        directions: Directions = LINE,
        online: bool = False,
    ) -> None:
        """Run the sequential test of existence: set `presence`, and the span with the most evidence if it suffices.

        A path through all rows may jump from one target to a stronger one; a chain keeps one target only.

        Args:
            switching: Probability of appearance or disappearance from row to row.
            bridge: Longest gap, in rows, that does not end a span.
            piece: Smallest log likelihood ratio of an unbroken stretch, and of a span without its strongest row, nats.
                Weaker stretches count as noise.
            whole: Smallest log likelihood ratio of a span, nats.
            max_step: Largest plausible change of bearing between rows, deg.
            rules: Thresholds of the test.
            directions: Geometry of the bearings.
            online: More rows may follow the last one.
        """
        there = presence(self.existence_likelihood, switching, self.prior_presence)
        ratio = np.log(self.existence_likelihood)
        kept = there.copy()
        jumps = np.flatnonzero(np.abs(np.diff(directions.unwrapped(self.bearings))) > max_step) + 1
        for span in _split(spans(there, bridge=0), jumps):
            if ratio[span.first : span.last + 1].sum() < piece:
                kept[span.first : span.last + 1] = 0.0
        jumps = np.union1d(jumps, self._implausible(spans(kept, bridge=0), bridge, rules, directions))
        candidates = [_trimmed(ratio, span, rules) for span in _split(spans(kept, bridge=bridge), jumps)]
        best = max(candidates, key=lambda item: item[1], default=(Span(0, -1), -np.inf))
        # A single row, however loud, is no track, unless more rows may follow it.
        after = min(best[0].last + 1, len(ratio) - online)
        rest = best[1] - float(ratio[best[0].first : after].max(initial=0.0))
        self.spans, self.evidence = ([best[0]], [best[1]]) if best[1] >= whole and rest >= piece else ([], [])
        margin = rules.margin_rows
        may_be = np.zeros(len(there), np.bool_)
        for span in self.spans:
            before = int(jumps[jumps <= span.first].max(initial=0))
            after = int(jumps[jumps > span.last].min(initial=len(there)))
            may_be[max(before, span.first - margin) : min(after, span.last + 1 + margin)] = True
        self.presence = np.where(may_be, there, 0.0)

    def _implausible(self, pieces: list[Span], bridge: int, rules: SpanRules, directions: Directions) -> Labels:
        """First rows of pieces that lie off the extrapolated piece before."""
        found = []
        for one, other in pairwise(pieces):
            steps = other.first - one.last
            if steps > bridge + 1:
                continue
            rate = 0.5 * (
                self.rates[max(one.first, one.last + 1 - rules.rate_rows) : one.last + 1].mean()
                + self.rates[other.first : min(other.first + rules.rate_rows, other.last + 1)].mean()
            )
            ahead = self.bearings[one.last] + rate * steps * self.period
            error = abs(directions.difference(ahead, self.bearings[other.first]))
            if error > rules.bridge_distance + rules.bridge_growth * steps:
                found.append(other.first)
        return np.array(found, np.int64)


def _split(whole: list[Span], breaks: Labels) -> list[Span]:
    """Split spans before the rows in `breaks`."""
    parts = []
    for span in whole:
        inside = breaks[(breaks > span.first) & (breaks <= span.last)].tolist()
        firsts, lasts = [span.first, *inside], [*(row - 1 for row in inside), span.last]
        parts += [Span(first, last) for first, last in zip(firsts, lasts, strict=True)]
    return parts


def _trimmed(ratio: Array, span: Span, rules: SpanRules) -> tuple[Span, float]:
    """Cut rows with little evidence off both ends of a span; return the span and its evidence.

    Before a track begins, a path through noise leads to it, whose rows have little evidence.
    """
    values = ratio[span.first : span.last + 1]
    cost = min(rules.trim_share * max(float(values.mean()), 0.0), rules.trim_limit)
    total = np.concatenate([[0.0], np.cumsum(values - cost)])
    lowest = np.minimum.accumulate(total)
    last = int((total - lowest).argmax())
    first = int(total[: last + 1].argmin())
    if last == first:
        return span, float(values.sum())
    return Span(span.first + first, span.first + last - 1), float(values[first:last].sum())
