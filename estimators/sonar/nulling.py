"""The best path through a record, taken out of it, and again: Viterbi with nulling."""

from __future__ import annotations

from dataclasses import dataclass
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
from servotrack.estimators.types import Array


class NullingState(NamedTuple):
    """Memory of a `ViterbiNulling`.

    Attributes:
        rows: The newest rows. Shape (W, beams).
        places: Identity and last estimated bearing of each track, deg.
        next_label: The next new identity.
    """

    rows: Array
    places: tuple[tuple[int, float], ...]
    next_label: int


@dataclass(frozen=True)
class ViterbiNulling:
    """The path of most power, then the next one with the beams about the first taken out, until one does not exist.

    Attributes:
        beams: Look directions from 0 to 180 deg.
        averages: M of one beam power.
        period: Time between rows, s.
        rates: Bearing rates of the grid, deg/s.
        acceleration: Standard deviation of the bearing's acceleration, deg/s^2.
        switching: Probability that a target comes or goes from row to row.
        bridge: Gaps of at most this long do not end a track, s.
        evidence: Least log likelihood ratio of a track, nats; a best path has some in mere noise.
        width: Beams within this of a path are taken out, deg.
        max_targets: Most paths.
        lag: Rows by which `step` answers later.
        window: Rows that `step` looks at.
        same: Farthest that a track moves between two rows of answers, deg.
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

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it, and the spacing that fits the rates."""
        if not 0 <= self.lag < self.window:
            raise ValueError(f"lag must lie in 0..window - 1, got lag={self.lag!r}, window={self.window!r}")
        if self.max_targets < 1:
            raise ValueError(f"max_targets must be at least 1, got {self.max_targets!r}")
        for name in ("width", "evidence", "same"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        self.chain  # noqa: B018  the grid checks the rates

    @cached_property
    def chain(self) -> GridChain:
        """The grid of bearings and rates."""
        return grid_chain(self.beams, self.rates, 180.0 / (self.beams - 1), self.period, self.acceleration)

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """All tracks of a record; arguments, result and errors as `HMMBearings.track`."""
        rows = checked_record(record, self.beams, self.averages, times, self.period)
        return self._paths(rows) if len(rows) else []

    def initial(self, row: ArrayLike) -> NullingState:
        """Memory before the first row; `row` is only looked at for its length."""
        checked_row(row, self.beams, self.averages)
        return NullingState(np.zeros((0, self.beams)), (), 1)

    def step(self, state: NullingState, row: ArrayLike) -> tuple[NullingState, SetEstimate]:
        """Take one row in; the estimate is of the row `lag` before, none while there is none."""
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
        looks, chain = bearings(self.beams), self.chain
        ratio = np.log(cell_likelihood(rows))
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
                if evidence < self.evidence * min(1.0, len(rows) / 60.0):
                    continue
                found = True
                spread = np.zeros(span.last + 1 - span.first)
                tracks.append(
                    BearingTrack(
                        len(tracks) + 1,
                        span.first,
                        looks[cell[part]],
                        chain.rates[rate[part]],
                        spread,
                        there[part],
                        evidence,
                    )
                )
                near = np.abs(looks - looks[cell[part]][:, None]) <= self.width
                ratio[part][near] = ratio.min()
            if not found:
                break
        return tracks
