"""Parameters of the hidden Markov bearing tracker and its cached tables: grid chain, beam patterns, matched filter."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from servotrack.estimators.hmm.chain import GridChain, grid_chain
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.sonar.beam_patterns import Patterns
from servotrack.estimators.sonar.rules import (
    BackgroundRules,
    CrossingRules,
    FastRules,
    JoiningRules,
    LikelihoodRules,
    SearchRules,
    SpanRules,
)
from servotrack.estimators.sonar.scores import RowScores
from servotrack.estimators.types import Array

if sys.version_info >= (3, 11):
    from typing import Self
else:
    from typing_extensions import Self

Likelihood = Literal["row", "cell"]


def fitting_rates(spacing: float, period: float, fastest: float = 2.0) -> tuple[float, ...]:
    """Return rates up to `fastest`, deg/s; half a step of the rate moves a target by one beam per row.

    The grid holds at least one step on both sides of zero.

    Args:
        spacing: Distance of neighboring beams, deg.
        period: Time between rows, s.
        fastest: Largest rate, deg/s, rounded to a step. Larger values follow faster targets and are slower.
    """
    step = 2.0 * spacing / period
    most = max(1, round(fastest / step))
    return tuple((step * np.arange(-most, most + 1)).tolist())


@dataclass(frozen=True)
class BearingModel:
    """Parameters of the hidden Markov bearing tracker (Jiang and Zhou 2016), and tables computed on first use.

    Attributes:
        likelihood: `row` compares whole rows with the array's beam patterns and subtracts the power explained by other
            targets; `cell` is the paper's method: each beam alone, cells of other targets excluded.
        array: Line array of the receiver.
        band: Frequency bins over which the receiver sums.
        shading: Shading of the elements.
        beams: Number of beams from 0 to 180 deg.
        snapshots: Number of snapshots averaged in one row.
        period: Time between rows, s.
        rates: Bearing rates of the grid, deg/s. None: up to 2 deg/s in steps that fit the beams, and as far beyond as
            ridges in the record move.
        acceleration: Standard deviation of the bearing's acceleration, deg/s^2. Larger values follow maneuvers faster
            and average fewer rows.
        switching: Probability that a target appears or disappears from row to row. Larger values react faster.
        bridge: Longest gap that does not end a track, s.
        evidence: Smallest log likelihood ratio of a track, nats. Larger values report fewer false and fewer weak
            tracks.
        evidence_of_piece: Smallest log likelihood ratio of an unbroken stretch of a track, nats.
        model_error: Relative standard deviation of the power explained by other targets (`row`).
        misplaced: Number of beams by which a pattern may be misplaced (`row`).
        power_spread: Relative standard deviation of a target's power from row to row (`row`).
        weakest: Smallest expected power of a target, in standard deviations of the noise (`row`).
        spread_beams: Number of beams to each side that a target occupies (`cell`).
        max_targets: Largest number of chains.
        sweeps: Number of turns of a new chain with its neighbors, and of all chains at the end.
        lag: Delay of the estimates of `step`, rows. Larger values are more accurate.
        window: Number of rows that `step` smooths, more than `lag`.
        memory_limit: Largest memory of `track`, bytes; longer records are rejected.
        jump: Change of an estimate between rows, beyond the fastest rate, that still counts as the same target, deg.
        likelihood_rules: Parameters of the likelihood ratio of a row.
        spans: Thresholds of location and existence.
        search: Thresholds of the joint search.
        crossing: Thresholds of the test for exchanged identities.
        joining: Thresholds that join parts of a track.
        backgrounds: Thresholds of the background and the noise level of rows.
        fast: Thresholds of the search for ridges that are faster than the grid.
    """

    likelihood: Likelihood = "row"
    array: LineArray = field(default_factory=LineArray)
    band: Band = field(default_factory=Band)
    shading: Shading = "conventional"
    beams: int = 721
    snapshots: int = 10
    period: float = 1.0
    rates: tuple[float, ...] | None = None
    acceleration: float = 0.3
    switching: float = 0.02
    bridge: float = 6.0
    evidence: float = 10.0
    evidence_of_piece: float = 4.0
    model_error: float = 0.15
    misplaced: int = 4
    power_spread: float = 0.3
    weakest: float = 1.5
    spread_beams: int = 8
    max_targets: int = 12
    sweeps: int = 2
    lag: int = 5
    window: int = 20
    memory_limit: float = 4e9
    jump: float = 2.0
    likelihood_rules: LikelihoodRules = field(default_factory=LikelihoodRules)
    spans: SpanRules = field(default_factory=SpanRules)
    search: SearchRules = field(default_factory=SearchRules)
    crossing: CrossingRules = field(default_factory=CrossingRules)
    joining: JoiningRules = field(default_factory=JoiningRules)
    backgrounds: BackgroundRules = field(default_factory=BackgroundRules)
    fast: FastRules = field(default_factory=FastRules)

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it, and the spacing that fits the rates."""
        if self.likelihood not in get_args(Likelihood):
            raise ValueError(f"likelihood must be one of {', '.join(get_args(Likelihood))}, got {self.likelihood!r}")
        supported = self.array.elements // 2
        if not 1 <= self.max_targets <= supported:
            raise ValueError(
                f"max_targets must lie in 1..{supported} for an array of {self.array.elements} elements, "
                f"got {self.max_targets!r}"
            )
        if not 0 <= self.lag < self.window:
            raise ValueError(f"lag must lie in 0..window - 1, got lag={self.lag!r}, window={self.window!r}")
        for name in ("snapshots", "sweeps", "misplaced", "spread_beams"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        for name in ("model_error", "power_spread", "weakest", "memory_limit", "jump"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        if not 0.0 < self.switching < 1.0:
            raise ValueError(f"switching must lie in (0, 1), got {self.switching!r}")
        if not self.bridge >= 0.0:
            raise ValueError(f"bridge must be >= 0, got {self.bridge!r}")
        self.chain  # noqa: B018  the grid checks the rates

    @cached_property
    def chain(self) -> GridChain:
        """Markov chain on the grid of bearings and rates."""
        rates = fitting_rates(self.spacing, self.period) if self.rates is None else self.rates
        return grid_chain(self.beams, rates, self.spacing, self.period, self.acceleration)

    @property
    def spacing(self) -> float:
        """Distance of neighboring beams, deg."""
        return 180.0 / (self.beams - 1)

    @cached_property
    def beam_width(self) -> float:
        """Width of a beam across the array at half its power, for a flat spectrum, in beams."""
        table = self.patterns.tables[0]
        half = min(2.0 / (len(table) - 1) * int((table < 0.5).argmax()), 1.0)
        return 2.0 * math.degrees(math.asin(half)) / self.spacing

    @property
    def fastest(self) -> float:
        """Largest rate of the grid, deg/s."""
        return float(self.chain.rates[-1])

    def widened(self, fastest: float) -> Self:
        """Return the same model with a grid of rates up to `fastest`, deg/s, and the tables that it has."""
        wider = replace(self, rates=fitting_rates(self.spacing, self.period, fastest))
        shared = ("patterns", "scores", "beam_bearings", "beam_width")
        wider.__dict__.update({name: self.__dict__[name] for name in shared if name in self.__dict__})
        return wider

    @cached_property
    def beam_bearings(self) -> Array:
        """Bearings of the beams, deg. Shape (beams,)."""
        return bearings(self.beams)

    @cached_property
    def patterns(self) -> Patterns:
        """Beam patterns of targets."""
        return Patterns(self.array, self.band, self.shading)

    @cached_property
    def scores(self) -> RowScores:
        """Matched filter over rows."""
        return RowScores(self.patterns, self.beam_bearings, self.averages, self.model_error, self.misplaced)

    @property
    def averages(self) -> int:
        """Number M of averages in one beam power: frequency bins times snapshots."""
        return len(self.band.frequencies) * self.snapshots

    @property
    def bridge_rows(self) -> int:
        """Longest gap that does not end a track, rows."""
        return int(self.bridge / self.period + 1e-9)

    @property
    def max_step(self) -> float:
        """Largest plausible change of a bearing between rows, deg; a larger one belongs to another target."""
        return float(np.abs(self.chain.rates).max()) * self.period + self.jump

    def memory(self, records: int, targets: int = 2) -> int:
        """Memory that `track` needs, bytes.

        Args:
            records: Number of rows.
            targets: Number of targets.
        """
        kept = self.chain.states if self.likelihood == "cell" else 0
        per_target = 3 * self.beams + kept
        return 8 * records * (2 * self.chain.states + 10 * self.beams + targets * per_target)
