"""Targets in bearing-time records by hidden Markov models: many chains, each followed before it is detected."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.chain import GridChain, grid_chain
from servotrack.estimators.hmm.smoothing import advance
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.sonar.beam_patterns import Patterns
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.sonar.record import BearingTrack, checked_record, checked_row, joined
from servotrack.estimators.sonar.scores import RowScores
from servotrack.estimators.types import Array

Likelihood = Literal["row", "cell"]


JUMP = 2.0
"""By how much an estimate may jump without being another target's, deg."""


class ChainMemory(NamedTuple):
    """What is kept of a chain between two rows.

    Attributes:
        label: Identity.
        prior: Of the states at the window's first row. Shape (S,).
        prior_presence: At the window's first row.
        presence: In the window's rows. Shape (W,).
        mixture: Its spectrum.
        bearings: In the window's rows, deg. Shape (W,).
        expected: Its power in the window's rows. Shape (W,).
    """

    label: int
    prior: Array
    prior_presence: float
    presence: Array
    mixture: Array
    bearings: Array
    expected: Array


class BearingState(NamedTuple):
    """Memory of an `HMMBearings`, of constant size.

    Attributes:
        rows: The newest normalized rows, at most `window`. Shape (W, beams).
        chains: What is followed.
        next_label: The next new identity.
        seen: Number of rows so far.
    """

    rows: Array
    chains: tuple[ChainMemory, ...]
    next_label: int
    seen: int


@dataclass(frozen=True)
class HMMBearings:
    """Tracks in a bearing-time record (paper 003), by whole rows or by single cells.

    `track` takes a whole record; `initial` and `step` take one row after the other and answer `lag` rows later.

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

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """All tracks of a record.

        Args:
            record: Beam powers, one row a period. Shape (T, beams).
            times: Of the rows, s; None: no gaps. Shape (T,).

        Returns:
            Tracks, strongest first, with labels from 1.

        Raises:
            ValueError: For rows of another length, NaN or negative powers, a gap in time, or a record that needs more
                memory than `memory_limit`.
        """
        rows = checked_record(record, self.beams, self.averages, times, self.period)
        needed = self.memory(len(rows))
        if needed > self.memory_limit:
            raise ValueError(
                f"record of {len(rows)} rows needs {needed / 1e9:.1f} GB, memory_limit is {self.memory_limit / 1e9:g} "
                "GB: raise it, or use initial and step, whose memory is constant"
            )
        if not len(rows):
            return []
        together = JointSmoother(self, rows)
        together.search(attempts=2)
        together.conclude()
        parts = [
            BearingTrack.cut(0, chain, span, value)
            for chain in together.chains
            for span, value in zip(chain.spans, chain.evidence, strict=True)
        ]
        return joined(parts, self.bridged, self.period)

    def initial(self, row: ArrayLike) -> BearingState:
        """Memory before the first row; `row` is only looked at for its length.

        Raises:
            ValueError: As `track`.
        """
        checked_row(row, self.beams, self.averages)
        return BearingState(np.zeros((0, self.beams)), (), 1, 0)

    def step(self, state: BearingState, row: ArrayLike) -> tuple[BearingState, SetEstimate]:
        """Take one row in and estimate the targets `lag` rows before it.

        Args:
            state: Memory.
            row: Beam powers. Shape (beams,).

        Returns:
            The new memory, and bearings (deg) and rates (deg/s) of the row `lag` before; none while there is none.

        Raises:
            ValueError: As `track`.
        """
        rows = np.vstack([state.rows, checked_row(row, self.beams, self.averages)])
        together = JointSmoother(self, rows, [self._recall(memory, len(rows)) for memory in state.chains])
        for chain in together.chains:
            together._explain(chain)
        together.sweep(1)
        together.search(attempts=1)
        next_label = state.next_label
        for chain in together.chains:
            if chain.label == 0:
                chain.label, next_label = next_label, next_label + 1
        at = len(rows) - 1 - self.lag
        estimate = self._estimate(together.chains, at)
        slide = len(rows) >= self.window
        kept = tuple(self._remember(chain, slide) for chain in together.chains)
        return BearingState(rows[1:] if slide else rows, kept, next_label, state.seen + 1), estimate

    def _recall(self, memory: ChainMemory, rows: int) -> TrackHypothesis:
        """A chain in the window with its new row, for which the last row's values stand."""
        extra = rows - len(memory.presence)
        presence, bearing, expected = (
            np.concatenate([values, np.repeat(values[-1:], extra)])
            for values in (memory.presence, memory.bearings, memory.expected)
        )
        return TrackHypothesis(
            np.maximum(presence, self.switching),
            memory.mixture,
            bearings=bearing,
            power=expected.copy(),
            expected=expected,
            label=memory.label,
            prior=memory.prior,
            period=self.period,
            prior_presence=memory.prior_presence,
        )

    def _remember(self, chain: TrackHypothesis, slide: bool) -> ChainMemory:
        prior = self.chain.uniform() if chain.prior is None else chain.prior
        there = chain.prior_presence
        first = 0
        if slide:
            prior = advance(self.chain, prior, chain.likelihood[0], float(chain.presence[0]))
            ratio = float(chain.existence_likelihood[0])
            there = there * ratio / (there * ratio + 1.0 - there)
            there = there * (1.0 - self.switching) + (1.0 - there) * self.switching
            first = 1
        expected = np.zeros(len(chain.presence)) if chain.expected is None else chain.expected
        return ChainMemory(
            chain.label, prior, there, chain.presence[first:], chain.mixture, chain.bearings[first:], expected[first:]
        )

    def _estimate(self, chains: list[TrackHypothesis], at: int) -> SetEstimate:
        """What is believed of one row of the window."""
        chains = [] if at < 0 else chains
        inside = np.array([any(s.first <= at <= s.last for s in chain.spans) for chain in chains], np.bool_)
        states = np.array([[chain.bearings[at], chain.rates[at]] for chain in chains]).reshape(-1, 2)
        labels = np.array([chain.label for chain in chains], np.int64)
        existence = np.array([chain.presence[at] for chain in chains], np.float64)
        covariances = np.zeros((len(chains), 2, 2))
        covariances[:, 0, 0] = [chain.deviations[at] ** 2 for chain in chains]
        return SetEstimate(
            states[inside],
            labels[inside],
            np.maximum(existence[inside], 0.5),
            covariances[inside],
            np.asarray(existence.sum()),
            labels[~inside],
            states[~inside],
            np.minimum(existence[~inside], 0.49),
        )
