"""One chain in a record: where its target is, how strong, with which pattern, and from when to when."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from servotrack.estimators.hmm.existence import Span, presence, spans
from servotrack.estimators.types import Array, Labels

ABOUT_MODE = 2.0
"""The estimate is the mean of the probabilities within this of their mode, deg."""
EDGE = 8
"""Rows before and after a span in which its target may be, for the next sweep."""

BRIDGE_DISTANCE, BRIDGE_RATE = 2.0, 0.3
"""How far beside its course a target may be after a gap, deg, and how much more per row, deg."""
TRIM_SHARE, TRIM_MOST = 0.3, 1.0
"""Rows at a track's ends belong to it if they say this share of what its rows say on average, or this much, nats."""


@dataclass(eq=False)
class TrackHypothesis:
    """What is known of one chain's target, row by row.

    Attributes:
        presence: Probability that it is there. Shape (T,).
        mixture: Its spectrum, as `Patterns` has it.
        bearings: deg. Shape (T,).
        rates: deg/s. Shape (T,).
        deviations: Standard deviation of bearings, deg. Shape (T,).
        power: Above the noise in the beam that looks at it. Shape (T,).
        expected: Its power as the rows around tell it; None before it was fitted. Shape (T,).
        pattern: Its beam pattern, peak 1. Shape (T, beams).
        existence_likelihood: Lam_k. Shape (T,).
        likelihood: Of the rows under its positions or states, in the last sweep. Shape (T, W).
        marginal: Of the states, where others need it. Shape (T, S).
        spans: Rows in which it is there.
        evidence: Log likelihood ratio of each span.
        label: Identity, 0 while it has none.
        prior: Of the states at the first row; None: uniform. Shape (S,).
        period: Time between rows, s.
        prior_presence: At the first row.
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

    def locate(self, marginal: Array, looks: Array, rates: Array) -> None:
        """Bearings, rates and deviations from the probabilities of all states, shape (T, S)."""
        cells = marginal.reshape(len(marginal), len(rates), len(looks))
        positions = cells.sum(axis=1)
        half = round(ABOUT_MODE / (looks[1] - looks[0]))
        index = positions.argmax(axis=1)[:, None] + np.arange(-half, half + 1)
        inside = (index >= 0) & (index < len(looks))
        index = np.clip(index, 0, len(looks) - 1)
        weight = np.take_along_axis(positions, index, axis=1) * inside
        weight /= weight.sum(axis=1, keepdims=True)
        near = looks[index]
        self.bearings = (weight * near).sum(axis=1)
        self.deviations = np.sqrt((weight * (near - self.bearings[:, None]) ** 2).sum(axis=1))
        self.rates = np.einsum("trp,r->t", cells, rates)

    def test_existence(self, switching: float, bridge: int, piece: float, whole: float, farthest: float) -> None:
        """The sequential test: presence, and the span of most evidence, if it has enough.

        A path through all rows may jump from one target to a stronger one; a chain keeps to one.

        Args:
            switching: Probability of coming or going from row to row.
            bridge: Gaps of at most this many rows do not end a span.
            piece: Least log likelihood ratio of an unbroken stretch, nats: what is less is noise.
            whole: Least log likelihood ratio of a span, nats.
            farthest: That a bearing moves from row to row, deg.
        """
        there = presence(self.existence_likelihood, switching, self.prior_presence)
        ratio = np.log(self.existence_likelihood)
        kept = there.copy()
        jumps = np.flatnonzero(np.abs(np.diff(self.bearings)) > farthest) + 1
        for span in _split(spans(there, bridge=0), jumps):
            if ratio[span.first : span.last + 1].sum() < piece:
                kept[span.first : span.last + 1] = 0.0
        jumps = np.union1d(jumps, self._implausible(spans(kept, bridge=0), bridge))
        candidates = [_trimmed(ratio, span) for span in _split(spans(kept, bridge=bridge), jumps)]
        best = max(candidates, key=lambda item: item[1], default=(Span(0, -1), -np.inf))
        self.spans, self.evidence = ([best[0]], [best[1]]) if best[1] >= whole else ([], [])
        may_be = np.zeros(len(there), np.bool_)
        for span in self.spans:
            before = int(jumps[jumps <= span.first].max(initial=0))
            after = int(jumps[jumps > span.last].min(initial=len(there)))
            may_be[max(before, span.first - EDGE) : min(after, span.last + 1 + EDGE)] = True
        self.presence = np.where(may_be, there, 0.0)

    def _implausible(self, pieces: list[Span], bridge: int) -> Labels:
        """First rows of pieces to which the one before does not lead, carried on over the gap."""
        found = []
        for one, other in pairwise(pieces):
            steps = other.first - one.last
            if steps > bridge + 1:
                continue
            rate = 0.5 * (
                self.rates[max(one.first, one.last - 4) : one.last + 1].mean()
                + self.rates[other.first : min(other.first + 5, other.last + 1)].mean()
            )
            error = abs(self.bearings[one.last] + rate * steps * self.period - self.bearings[other.first])
            if error > BRIDGE_DISTANCE + BRIDGE_RATE * steps:
                found.append(other.first)
        return np.array(found, np.int64)


def _split(whole: list[Span], breaks: Labels) -> list[Span]:
    """Spans, cut before each of some rows."""
    parts = []
    for span in whole:
        inside = breaks[(breaks > span.first) & (breaks <= span.last)].tolist()
        firsts, lasts = [span.first, *inside], [*(row - 1 for row in inside), span.last]
        parts += [Span(first, last) for first, last in zip(firsts, lasts, strict=True)]
    return parts


def _trimmed(ratio: Array, span: Span) -> tuple[Span, float]:
    """A span without rows at its ends that say much less than its other rows, and its evidence.

    Where a track begins, a path through noise leads to it, whose rows say a little.
    """
    values = ratio[span.first : span.last + 1]
    cost = min(TRIM_SHARE * max(float(values.mean()), 0.0), TRIM_MOST)
    total = np.concatenate([[0.0], np.cumsum(values - cost)])
    lowest = np.minimum.accumulate(total)
    last = int((total - lowest).argmax())
    first = int(total[: last + 1].argmin())
    if last == first:
        return span, float(values.sum())
    return Span(span.first + first, span.first + last - 1), float(values[first:last].sum())
