"""Viterbi with nulling: find the best path through a record, remove it, and repeat."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.chain import GridChain, grid_chain
from servotrack.estimators.hmm.existence import presence, spans
from servotrack.estimators.hmm.viterbi import best_path
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.sonar.array import bearings
from servotrack.estimators.sonar.likelihood import cell_likelihood
from servotrack.estimators.sonar.record import BearingTrack, checked_record, checked_row
from servotrack.estimators.sonar.rules import LikelihoodRules
from servotrack.estimators.types import Array


class NullingState(NamedTuple):
    """State of a `ViterbiNulling`.

    Attributes:
        rows: Newest rows. Shape (W, beams).
        places: Identity and last estimated bearing of each track, deg.
        next_label: Next new identity.
    """

    rows: Array
    places: tuple[tuple[int, float], ...]
    next_label: int


@dataclass(frozen=True)
class ViterbiNulling:
    """Baseline tracker: take the path of most power, null the beams about it, repeat until a path fails the test.

    Attributes:
        beams: Number of beams from 0 to 180 deg.
        averages: Number M of averages in one beam power.
        period: Time between rows, s.
        rates: Bearing rates of the grid, deg/s.
        acceleration: Standard deviation of the bearing's acceleration, deg/s^2.
        switching: Probability that a target appears or disappears from row to row.
        bridge: Longest gap that does not end a track, s.
        evidence: Smallest log likelihood ratio of a track, nats. It exceeds that of the best path through noise.
        width: Half-width of the band of beams nulled about a path, deg.
        max_targets: Largest number of paths.
        lag: Delay of the estimates of `step`, rows.
        window: Number of rows that `step` uses.
        same: Largest change of a track's bearing between two estimates, deg.
        evidence_rows: Rows from which the full `evidence` is required; shorter records need proportionally less.
        likelihood_rules: Parameters of the likelihood ratio of a cell.
    """

    beams: int = 721
    averages: int = 1110
    period: float = 1.0
    rates: tuple[float, ...] = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
    acceleration: float = 0.3
    switching: float = 0.02
    bridge: float = 6.0
    evidence: float = 40.0
    width: float = 3.0
    max_targets: int = 12
    lag: int = 5
    window: int = 20
    same: float = 4.0
    evidence_rows: int = 60
    likelihood_rules: LikelihoodRules = field(default_factory=LikelihoodRules)

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it, and the spacing that fits the rates."""
        if not 0 <= self.lag < self.window:
            raise ValueError(f"lag must lie in 0..window - 1, got lag={self.lag!r}, window={self.window!r}")
        if self.max_targets < 1:
            raise ValueError(f"max_targets must be at least 1, got {self.max_targets!r}")
        for name in ("width", "evidence", "same", "evidence_rows"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        self.chain  # noqa: B018  the grid checks the rates

    @cached_property
    def chain(self) -> GridChain:
        """Markov chain on the grid of bearings and rates."""
        return grid_chain(self.beams, self.rates, 180.0 / (self.beams - 1), self.period, self.acceleration)

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """Track all targets of a whole record; arguments, result and errors as in `HMMBearings.track`."""
        checked = checked_record(record, self.beams, self.averages, times, self.period)
        return checked.restored(self._paths(checked.rows)) if len(checked.rows) else []

    def initial(self, row: ArrayLike) -> NullingState:
        """Return the state before the first row; only the length of `row` is used."""
        checked_row(row, self.beams, self.averages)
        return NullingState(np.zeros((0, self.beams)), (), 1)

    def step(self, state: NullingState, row: ArrayLike) -> tuple[NullingState, SetEstimate]:
        """Update with one row; the estimate is that of the row `lag` before, empty during the first `lag` rows."""
        rows = np.vstack([state.rows, checked_row(row, self.beams, self.averages)])[-self.window :]
        at = len(rows) - 1 - self.lag
        shown = [t for t in self._paths(rows) if t.first <= at <= t.last] if at >= 0 else []
        states = np.array([[t.bearings[at - t.first], t.rates[at - t.first]] for t in shown]).reshape(-1, 2)
        free = dict(state.places)
        labels = np.zeros(len(shown), np.int64)
        next_label = state.next_label
        for i, bearing in enumerate(states[:, 0].tolist()):
            nearest = min(free, key=lambda label: abs(free[label] - bearing), default=0)
            if nearest and abs(free[nearest] - bearing) < self.same:
                labels[i] = nearest
                del free[nearest]
            else:
                labels[i], next_label = next_label, next_label + 1
        places = tuple(zip(labels.tolist(), states[:, 0].tolist(), strict=True))
        none = np.zeros((0, 2))
        estimate = SetEstimate(
            states,
            labels,
            np.ones(len(shown)),
            np.zeros((len(shown), 2, 2)),
            np.asarray(float(len(shown))),
            np.zeros(0, np.int64),
            none,
            np.zeros(0),
        )
        return NullingState(rows, places, next_label), estimate

    def _paths(self, rows: Array) -> list[BearingTrack]:
        beam_bearings, chain = bearings(self.beams), self.chain
        missing = np.isnan(rows[:, 0])
        ratio = np.log(cell_likelihood(np.where(missing[:, None], 1.0, rows), self.likelihood_rules))
        ratio[missing] = 0.0
        tracks: list[BearingTrack] = []
        for _ in range(self.max_targets):
            path, _ = best_path(chain, ratio)
            rate, cell = path // self.beams, path % self.beams
            along = ratio[np.arange(len(rows)), cell]
            there = presence(np.exp(along), self.switching)
            found = False
            for span in spans(there, bridge=int(self.bridge / self.period + 1e-9)):
                part = slice(span.first, span.last + 1)
                evidence = float(along[part].sum())
                if evidence < self.evidence * min(1.0, len(rows) / self.evidence_rows):
                    continue
                found = True
                spread = np.zeros(span.last + 1 - span.first)
                tracks.append(
                    BearingTrack(
                        len(tracks) + 1,
                        span.first,
                        beam_bearings[cell[part]],
                        chain.rates[rate[part]],
                        spread,
                        there[part],
                        evidence,
                    )
                )
                near = np.abs(beam_bearings - beam_bearings[cell[part]][:, None]) <= self.width
                ratio[part][near] = ratio.min()
            if not found:
                break
        return tracks
