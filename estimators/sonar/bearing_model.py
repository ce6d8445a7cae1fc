"""Parameters of the hidden Markov bearing tracker and its cached tables: grid chain, beam patterns, matched filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from servotrack.estimators.hmm.chain import GridChain, grid_chain
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.sonar.beam_patterns import Patterns
from servotrack.estimators.sonar.scores import RowScores
from servotrack.estimators.types import Array

Likelihood = Literal["row", "cell"]


JUMP = 2.0
"""By how much an estimate may jump without being another target's, deg."""


@dataclass(frozen=True)
class BearingModel:
    """Parameters of the hidden Markov bearing tracker (paper 003), and the tables computed from them on first use.

    Attributes:
        likelihood: `row` compares whole rows with the array's beam patterns and subtracts what other targets explain;
            `cell` is the paper's: each beam alone, other targets excluded.
        array: The receiver.
        band: The frequencies that it sums over.
        shading: Of its elements.
        beams: Look directions from 0 to 180 deg.
        snapshots: Averaged in one row.
        period: Time between rows, s.
        rates: Bearing rates of the grid, deg/s.
        acceleration: Standard deviation of the bearing's acceleration, deg/s^2.
        switching: Probability that a target comes or goes from row to row.
        bridge: Gaps of at most this long do not end a track, s.
        evidence: Least log likelihood ratio of a track, nats.
        evidence_of_piece: Least log likelihood ratio of each of its unbroken stretches, nats.
        model_error: Relative standard deviation of what other targets explain (`row`).
        misplaced: Beams by which a pattern may be misplaced (`row`).
        power_spread: Relative standard deviation of a target's power from row to row (`row`).
        weakest: Least power that is expected of a target, in standard deviations of the noise (`row`).
        spread_beams: Beams to each side that a target holds (`cell`).
        max_targets: Most chains.
        sweeps: Turns of a new chain and those that it meets most, and of all in the end.
        lag: Rows by which `step` answers later.
        window: Rows that `step` looks at, more than `lag`.
        memory_limit: Bytes above which `track` refuses a record.
    """

    likelihood: Likelihood = "row"
    array: LineArray = field(default_factory=LineArray)
    band: Band = field(default_factory=Band)
    shading: Shading = "conventional"
    beams: int = 721
    snapshots: int = 10
    period: float = 1.0
    rates: tuple[float, ...] = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
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

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it, and the spacing that fits the rates."""
        if self.likelihood not in get_args(Likelihood):
            raise ValueError(f"likelihood must be one of {', '.join(get_args(Likelihood))}, got {self.likelihood!r}")
        supported = self.array.elements // 2
        if not 1 <= self.max_targets <= supported:
            raise ValueError(
                f"max_targets must lie in 1..{supported}, what a record of {self.array.elements} elements supports, "
                f"got {self.max_targets!r}"
            )
        if not 0 <= self.lag < self.window:
            raise ValueError(f"lag must lie in 0..window - 1, got lag={self.lag!r}, window={self.window!r}")
        for name in ("snapshots", "sweeps", "misplaced", "spread_beams"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        for name in ("model_error", "power_spread", "weakest", "memory_limit"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        if not 0.0 < self.switching < 1.0:
            raise ValueError(f"switching must lie in (0, 1), got {self.switching!r}")
        if not self.bridge >= 0.0:
            raise ValueError(f"bridge must be >= 0, got {self.bridge!r}")
        self.chain  # noqa: B018  the grid checks the rates

    @cached_property
    def chain(self) -> GridChain:
        """The grid of bearings and rates."""
        spacing = 180.0 / (self.beams - 1)
        return grid_chain(self.beams, self.rates, spacing, self.period, self.acceleration)

    @cached_property
    def looks(self) -> Array:
        """Bearings of the beams, deg."""
        return bearings(self.beams)

    @cached_property
    def patterns(self) -> Patterns:
        """Beam patterns of targets."""
        return Patterns(self.array, self.band, self.shading)

    @cached_property
    def scores(self) -> RowScores:
        """The matched filter over rows."""
        return RowScores(self.patterns, self.looks, self.averages, self.model_error, self.misplaced)

    @property
    def averages(self) -> int:
        """Bins times snapshots in one beam power."""
        return len(self.band.frequencies) * self.snapshots

    @property
    def bridged(self) -> int:
        """Rows of a gap that does not end a track."""
        return int(self.bridge / self.period + 1e-9)

    @property
    def farthest(self) -> float:
        """That an estimate moves from row to row, deg; what moves farther is another target."""
        return float(np.abs(self.rates).max()) * self.period + JUMP

    def memory(self, records: int, targets: int = 2) -> int:
        """Bytes that `track` needs for so many rows and targets."""
        kept = self.chain.states if self.likelihood == "cell" else 0
        per_target = 3 * self.beams + kept
        return 8 * records * (2 * self.chain.states + 10 * self.beams + targets * per_target)
