"""Bearing tracker by hidden Markov models: several chains, each tracked before it is detected."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.smoothing import advance
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.sonar.array_check import measured_averages, width_note
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.fast_ridges import fastest_rate
from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.sonar.record import BearingTrack, checked_record, checked_row, joined
from servotrack.estimators.types import Array

if sys.version_info >= (3, 11):
    from typing import Self
else:
    from typing_extensions import Self


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
        rows: Newest normalized rows, at most `window`; NaN where a row is missing. Shape (W, beams).
        chains: States of the chains.
        next_label: Next new identity.
        seen: Number of rows so far.
        level: Noise level of the newest row that loud targets leave, relative to that of the row alone.
        fastest: Largest bearing rate of the grid, deg/s.
    """

    rows: Array
    chains: tuple[ChainMemory, ...]
    next_label: int
    seen: int
    level: float = 1.0
    fastest: float = 0.0


@dataclass(frozen=True)
class HMMBearings(BearingModel):
    """Bearing tracker by hidden Markov chains over a bearing-time record (Jiang and Zhou 2016).

    `track` takes a whole record. `initial` and `step` take one row after the other and answer `lag` rows later. The
    parameters are those of `BearingModel`.
    """

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """Track all targets of a whole record.

        Args:
            record: Beam powers, one row per period; a row of NaN is missing. Shape (T, beams).
            times: Times of the rows, s; periods without a row are missing. None: no gaps. Shape (T,).

        Returns:
            Tracks, strongest first, with labels from 1, at the given rows.

        Raises:
            ValueError: Rows have another length, powers are negative or NaN in some beams only, times do not fit the
                period, or the record needs more memory than `memory_limit`.

        Warns:
            RuntimeWarning: Ridges are wider or narrower than the array's beams, or faster than fixed rates.
        """
        beams = len(self.beam_bearings)
        checked = checked_record(record, beams, self.averages, times, self.period)
        model = self._with_spread_of(checked.rows)
        if model is not self:
            checked = checked_record(record, beams, model.averages, times, self.period)
        rows = checked.rows
        needed = model.memory(len(rows))
        if needed > self.memory_limit:
            raise ValueError(
                f"record of {len(rows)} rows needs {needed / 1e9:.1f} GB, memory_limit is {self.memory_limit / 1e9:g} "
                "GB: raise it, or use initial and step, whose memory is constant"
            )
        if not len(rows):
            return []
        smoother = JointSmoother(model, rows)
        fastest = model._fastest(smoother, self.fastest)
        if fastest > self.fastest:
            smoother = JointSmoother(model.widened(fastest), rows)
        smoother.search(attempts=2)
        for _ in range(self.backgrounds.max_levels):
            if smoother.relevel() is None:
                break
            # Chains on sidelobes that the wrong level left must not stay.
            smoother.chains.clear()
            smoother.search(attempts=2)
        smoother.conclude()
        note = width_note(smoother)
        if note is not None:
            warnings.warn(note, RuntimeWarning, stacklevel=2)
        parts = [
            BearingTrack.cut(0, chain, span, value)
            for chain in smoother.chains
            for span, value in zip(chain.spans, chain.evidence, strict=True)
        ]
        return checked.restored(joined(parts, self.bridge_rows, self.period, self.joining, self.directions))

    def initial(self, row: ArrayLike) -> BearingState:
        """Return the state before the first row; only the length of `row` is used.

        Raises:
            ValueError: As `track` does.
        """
        checked_row(row, len(self.beam_bearings), self.averages)
        return BearingState(np.zeros((0, len(self.beam_bearings))), (), 1, 0, 1.0, self.fastest)

    def step(self, state: BearingState, row: ArrayLike) -> tuple[BearingState, SetEstimate]:
        """Update with one row and estimate the targets `lag` rows before it.

        Args:
            state: State after the previous row.
            row: Beam powers; NaN in all beams if the row is missing. Shape (beams,).

        Returns:
            The new state, and bearings (deg) and rates (deg/s) at the row `lag` before; empty during the first `lag`
            rows.

        Raises:
            ValueError: As `track` does.
        """
        rows = np.vstack([state.rows, checked_row(row, len(self.beam_bearings), self.averages) / state.level])
        model, memories = self._at_rate(state.fastest), state.chains
        smoother = JointSmoother(model, rows, online=True)
        fastest = self._fastest(smoother, state.fastest)
        if fastest > state.fastest:
            wider = self._at_rate(fastest)
            memories = tuple(memory._replace(prior=_padded(memory.prior, model, wider)) for memory in memories)
            smoother.model = model = wider
        smoother.chains = [self._recall(memory, len(rows)) for memory in memories]
        for chain in smoother.chains:
            smoother._explain(chain)
        smoother.sweep(1)
        smoother.search(attempts=1)
        level = smoother.relevel()
        if level is not None:
            rows = rows / level[:, None]
            smoother.sweep(1)
            smoother.search(attempts=1)
        next_label = state.next_label
        for chain in smoother.chains:
            if chain.label == 0:
                chain.label, next_label = next_label, next_label + 1
        at = len(rows) - 1 - self.lag
        estimate = self._estimate(smoother.chains, at)
        slide = len(rows) >= self.window
        kept = tuple(self._remember(model, chain, slide) for chain in smoother.chains)
        relative = state.level if level is None else state.level * float(level[-1])
        return BearingState(rows[1:] if slide else rows, kept, next_label, state.seen + 1, relative, fastest), estimate

    def _fastest(self, smoother: JointSmoother, known: float) -> float:
        """Largest bearing rate that the rows need, deg/s; a fixed grid of rates keeps its own and warns."""
        # Online, lines that end in the newest row are new.
        some = slice(-(2 * self.fast.half_rows + 1), None) if smoother.online else slice(None)
        rows, background = self.on_grid(smoother.rows[some]), self.on_grid(smoother.background[some])
        found = fastest_rate(rows, background, self.averages, self.spacing, self.period, known, self.fast)
        if found <= known:
            return known
        if self.rates is not None:
            warnings.warn(
                f"a ridge moves at about {found:.3g} deg/s, and rates end at {known:.3g} deg/s: it is not followed; "
                "leave rates out, or extend them",
                RuntimeWarning,
                stacklevel=3,
            )
            return known
        return found + self.fast.margin

    def _with_spread_of(self, rows: Array) -> Self:
        """Return this tracker, or one whose number of averages is that of the noise in the rows if it differs."""
        measured = measured_averages(rows) if self.noise_averages is None else None
        if measured is None or abs(np.log(measured / self.averages)) < 2.0 * np.log(self.spread_tolerance):
            return self
        return self.changed(noise_averages=measured)

    def _at_rate(self, fastest: float) -> HMMBearings:
        """Return this tracker with a grid of rates up to `fastest`, deg/s; made once."""
        if fastest <= self.fastest:
            return self
        made: dict[float, HMMBearings] = self.__dict__.setdefault("_wider", {})
        if fastest not in made:
            made[fastest] = self.widened(fastest)
        return made[fastest]

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

    def _remember(self, model: BearingModel, chain: TrackHypothesis, slide: bool) -> ChainMemory:
        prior = model.chain.uniform() if chain.prior is None else chain.prior
        there = chain.prior_presence
        first = 0
        if slide:
            prior = advance(model.chain, prior, chain.likelihood[0], float(chain.presence[0]))
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


def _padded(prior: Array, model: BearingModel, wider: BearingModel) -> Array:
    """Probabilities of the states on a grid with more rates."""
    extra = (len(wider.chain.rates) - len(model.chain.rates)) // 2
    cells = prior.reshape(len(model.chain.rates), -1)
    return np.pad(cells, ((extra, extra), (0, 0))).reshape(-1)
