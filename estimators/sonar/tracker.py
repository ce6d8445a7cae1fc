"""Bearing tracker by hidden Markov models: several chains, each tracked before it is detected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.smoothing import advance
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.sonar.record import BearingTrack, checked_record, checked_row, joined
from servotrack.estimators.types import Array


class ChainMemory(NamedTuple):
    """State of one chain between two rows.

    Attributes:
        label: Identity.
        prior: Probabilities of the states at the window's first row. Shape (S,).
        prior_presence: Probability of existence at the window's first row.
        presence: Probability of existence in the window's rows. Shape (W,).
        mixture: Spectrum of the target, as a mixture of `Patterns`.
        bearings: Bearings in the window's rows, deg. Shape (W,).
        expected: Expected powers in the window's rows. Shape (W,).
    """

    label: int
    prior: Array
    prior_presence: float
    presence: Array
    mixture: Array
    bearings: Array
    expected: Array


class BearingState(NamedTuple):
    """State of an `HMMBearings`, of constant size.

    Attributes:
        rows: Newest normalized rows, at most `window`. Shape (W, beams).
        chains: States of the chains.
        next_label: Next new identity.
        seen: Number of rows so far.
    """

    rows: Array
    chains: tuple[ChainMemory, ...]
    next_label: int
    seen: int


@dataclass(frozen=True)
class HMMBearings(BearingModel):
    """Bearing tracker by hidden Markov chains over a bearing-time record (Jiang and Zhou 2016).

    `track` takes a whole record. `initial` and `step` take one row after the other and answer `lag` rows later. The
    parameters are those of `BearingModel`.
    """

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """Track all targets of a whole record.

        Args:
            record: Beam powers, one row per period. Shape (T, beams).
            times: Times of the rows, s; None: no gaps. Shape (T,).

        Returns:
            Tracks, strongest first, with labels from 1.

        Raises:
            ValueError: Rows have another length, powers are NaN or negative, there is a gap in time, or the record
                needs more memory than `memory_limit`.
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
        smoother = JointSmoother(self, rows)
        smoother.search(attempts=2)
        smoother.conclude()
        parts = [
            BearingTrack.cut(0, chain, span, value)
            for chain in smoother.chains
            for span, value in zip(chain.spans, chain.evidence, strict=True)
        ]
        return joined(parts, self.bridge_rows, self.period, self.joining)

    def initial(self, row: ArrayLike) -> BearingState:
        """Return the state before the first row; only the length of `row` is used.

        Raises:
            ValueError: As `track` does.
        """
        checked_row(row, self.beams, self.averages)
        return BearingState(np.zeros((0, self.beams)), (), 1, 0)

    def step(self, state: BearingState, row: ArrayLike) -> tuple[BearingState, SetEstimate]:
        """Update with one row and estimate the targets `lag` rows before it.

        Args:
            state: State after the previous row.
            row: Beam powers. Shape (beams,).

        Returns:
            The new state, and bearings (deg) and rates (deg/s) at the row `lag` before; empty during the first `lag`
            rows.

        Raises:
            ValueError: As `track` does.
        """
        rows = np.vstack([state.rows, checked_row(row, self.beams, self.averages)])
        smoother = JointSmoother(self, rows, [self._recall(memory, len(rows)) for memory in state.chains])
        for chain in smoother.chains:
            smoother._explain(chain)
        smoother.sweep(1)
        smoother.search(attempts=1)
        next_label = state.next_label
        for chain in smoother.chains:
            if chain.label == 0:
                chain.label, next_label = next_label, next_label + 1
        at = len(rows) - 1 - self.lag
        estimate = self._estimate(smoother.chains, at)
        slide = len(rows) >= self.window
        kept = tuple(self._remember(chain, slide) for chain in smoother.chains)
        return BearingState(rows[1:] if slide else rows, kept, next_label, state.seen + 1), estimate

    def _recall(self, memory: ChainMemory, rows: int) -> TrackHypothesis:
        """Rebuild a chain in the window with its new row, which starts with the values of the last row."""
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
        """Estimate of the set of targets at one row of the window."""
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
