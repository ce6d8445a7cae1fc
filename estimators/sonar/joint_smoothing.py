"""Many chains in one record, solved in turns: each chain sees the rows less what the others explain."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numba import njit

from servotrack.estimators.hmm.exclusion import exclude, occupancy
from servotrack.estimators.hmm.smoothing import smooth
from servotrack.estimators.sonar.beam_patterns import PowerFit, add_pattern, variance_of
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.crossings import resolve_crossings
from servotrack.estimators.sonar.likelihood import cell_likelihood, known_power, unknown_power
from servotrack.estimators.types import Array, Mask

APART = 0.06
"""Targets whose cosines of bearing differ by less are not resolved by the array of 48 elements."""
SURE = 0.3
"""Presence from which a row tells of a target's power and spectrum."""
FEWEST = 5
"""Rows from which a spectrum is fitted."""
AROUND = 20
"""Rows to each side whose median is the power that is expected of a target."""
NEGLIGIBLE = 1e-25
"""Probability below which the surroundings of a target that was found are left out of smoothing."""
MOST_EXCHANGES = 12
"""Of the rests of two chains after a meeting."""
SAME = 1.0
"""Two paths that are nearer for most of one's rows are one target's, deg."""
CLOSED = 2.0
"""About a ridge that failed the test of existence, or on which a chain was started, search does not look, deg."""
MET = 0.08
"""Difference of cosines of bearing below which two chains hold each other's power."""
NEIGHBORS = 2
"""Chains that are solved again beside a new one."""


class JointSmoother:
    """Chains in normalized rows.

    Args:
        model: Parameters and tables of the tracker.
        rows: Normalized beam powers. Shape (T, beams).
        chains: Chains that are followed already.
    """

    def __init__(self, model: BearingModel, rows: Array, chains: Sequence[TrackHypothesis] = ()) -> None:
        self.model = model
        self.rows = rows
        self.chains = list(chains)

    @cached_property
    def whitened(self) -> Array:
        """The rows less noise, as the matched filter takes them. Shape (T, beams)."""
        return self.model.scores.whiten(self.rows - 1.0)

    def search(self, attempts: int) -> None:
        """Start chains on the strongest unexplained ridge until the test of existence fails `attempts` in a row.

        A new chain is settled with few others, so that the solves of a record grow linearly with its targets. When
        no more are found, all chains are solved again, and the search goes on if that leaves something.

        A chain that only takes the place of another one counts as failed: the two would displace each other for ever.
        """
        failed, settled = 0, True
        closed, taken = np.zeros(self.rows.shape, np.bool_), np.zeros(self.rows.shape, np.bool_)
        unexplained: Array | None = None
        while True:
            if failed >= attempts or len(self.chains) >= self.model.max_targets:
                if settled:
                    return
                self.sweep(self.model.sweeps)
                failed, settled, unexplained = attempts - 1, True, None
                taken[:] = False
                continue
            chain = TrackHypothesis(np.ones(len(self.rows)), self.model.patterns.flat, period=self.model.period)
            if unexplained is None:
                unexplained = self._likelihood(chain)
            self._smooth(chain, unexplained, closed | taken)
            ridge, before = chain.bearings, len(self.chains)
            about = np.abs(self.model.looks - ridge[:, None]) < CLOSED
            if chain.spans and not self._followed_already(chain):
                there = chain.presence > SURE
                self.chains.append(chain)
                self._explain(chain)
                chain.power = np.full(len(self.rows), 0.0)
                settled &= self._settle(chain)
                unexplained = None
                if not settled:
                    # What others leave of its ridge until they are solved, too, is not another target.
                    taken |= about & there[:, None]
            if len(self.chains) > before:
                failed = 0
            else:
                failed += 1
                closed |= about

    def conclude(self) -> None:
        """Solve all chains of a whole record together, sort out who is who, and look for what is left."""
        if self.resolve_crossings():
            self.search(attempts=2)

    def _settle(self, new: TrackHypothesis) -> bool:
        """Solve a new chain and those that it meets most again, in turns; whether these are all.

        The first one has nobody to wait for. One that comes to go where another one is ends.
        """
        # A single cell does not tell whose power it holds: all have to make room.
        some = list(self.chains) if self.model.likelihood == "cell" else [new, *self._most_met(new)]
        everything = len(some) == len(self.chains)
        self.sweep(1 if len(self.chains) == 1 else self.model.sweeps, some)
        if not everything and new in self.chains and self._followed_already(new):
            self.chains.remove(new)
            self.fit()
        return everything

    def _most_met(self, new: TrackHypothesis) -> list[TrackHypothesis]:
        """The other chains that are near a new one in most rows, or else the nearest; at most `NEIGHBORS`."""

        def met(chain: TrackHypothesis) -> tuple[float, float]:
            both = (chain.presence > SURE) & (new.presence > SURE)
            bearings = np.radians(chain.bearings[both]), np.radians(new.bearings[both])
            apart = np.abs(np.cos(bearings[0]) - np.cos(bearings[1]))
            return float(np.maximum(0.0, 1.0 - apart / MET).sum()), -float(apart.min(initial=2.0))

        others = [chain for chain in self.chains if chain is not new]
        return sorted(others, key=met)[-NEIGHBORS:]

    def _followed_already(self, new: TrackHypothesis) -> bool:
        """Whether a chain goes where another one is: what that one leaves unexplained is no other target."""
        rows = slice(new.spans[0].first, new.spans[0].last + 1)
        return any(
            np.mean((np.abs(chain.bearings[rows] - new.bearings[rows]) < SAME) & (chain.presence[rows] > SURE)) > 0.5
            for chain in self.chains
            if chain is not new
        )

    def sweep(self, times: int, some: Sequence[TrackHypothesis] | None = None) -> None:
        """Solve all or some chains in turn, given the others; those that fail the test of existence end."""
        for _ in range(times):
            self.fit(some)
            for chain in [chain for chain in self.chains if some is None or chain in some]:
                self._smooth(chain, self._likelihood(chain))
                if chain.spans:
                    self._explain(chain)
                else:
                    self.chains.remove(chain)
        self.fit(some)

    def resolve_crossings(self) -> bool:
        """Give chains that changed targets where they met their own back; whether there were any."""
        if self.model.likelihood == "cell":
            return False
        changed = False
        for _ in range(MOST_EXCHANGES):
            others = [self.explained([chain]) for chain in self.chains]
            if not resolve_crossings(self.chains, self.model.patterns, self.rows, others, self.model.looks):
                break
            changed = True
            for chain in self.chains:
                self._explain(chain)
            self.sweep(1)
        return changed

    def explained(self, but: Sequence[TrackHypothesis] = ()) -> Array:
        """Mean beam powers by noise and all chains but some. Shape (T, beams)."""
        mean = np.ones_like(self.rows)
        for chain in self.chains:
            if chain not in but:
                add_pattern(mean, chain.presence * chain.power, chain.pattern)
        return mean

    def fit(self, some: Sequence[TrackHypothesis] | None = None) -> None:
        """Powers, what is expected of them, and spectra, of all chains or of some together; others stay as they are."""
        chains = [chain for chain in self.chains if some is None or chain in some]
        if self.model.likelihood == "cell" or not chains:
            return
        model = self.model
        there = np.array([chain.presence for chain in chains])
        alone = np.array([self._alone(chain) for chain in chains])
        patterns = np.array([chain.pattern for chain in chains])
        least = model.weakest / np.sqrt(model.averages)
        unknown = np.zeros_like(there), np.full_like(there, 1e3 * self.rows.max())
        excess = self.rows - self.explained(chains)
        mean = self.explained()
        for _ in range(2):
            variance = variance_of(mean, model.averages, 0.3 * model.model_error, model.misplaced // 2)
            powers = PowerFit.of(excess, patterns, there, variance)
            free = powers.powers(*unknown)
            usual = np.array([_running_median(p, use) for p, use in zip(free, alone, strict=True)])
            usual = np.maximum(usual, least)
            power = powers.powers(usual, model.power_spread * usual)
            for i, chain in enumerate(chains):
                chain.expected = usual[i]
                chain.power = np.where(there[i] > SURE, power[i], usual[i])
            mean = self.explained()
        cosines = np.cos(np.radians(model.looks))
        for chain, use in zip(chains, alone, strict=True):
            if use.sum() >= FEWEST:
                left = (self.rows - self.explained([chain]))[use]
                chain.mixture = model.patterns.fit(
                    left, variance[use], cosines, chain.bearings[use], np.maximum(chain.power[use], least)
                )

    def _alone(self, chain: TrackHypothesis) -> Mask:
        """Rows in which a chain's target is there and no other is too near to be told from it."""
        cosines = np.cos(np.radians(chain.bearings))
        alone = chain.presence > SURE
        for other in self.chains:
            if other is not chain:
                apart = np.abs(cosines - np.cos(np.radians(other.bearings)))
                alone &= ~((other.presence > SURE) & (apart < APART))
        return alone

    def _explain(self, chain: TrackHypothesis) -> None:
        if self.model.likelihood == "row":
            looks = self.model.looks
            chain.pattern = self.model.patterns.at(chain.mixture, np.cos(np.radians(looks)), chain.bearings)

    def _likelihood(self, chain: TrackHypothesis) -> Array:
        return self._cells(chain) if self.model.likelihood == "cell" else self._row(chain)

    def _smooth(self, chain: TrackHypothesis, b: Array, closed: Mask | None = None) -> None:
        """Smooth one chain and test its existence; a new chain, there in all rows, may not enter what is closed."""
        model = self.model
        if closed is not None and closed.any():
            b = np.where(np.tile(closed, (1, b.shape[1] // closed.shape[1])), 1.0, b)
        chain.likelihood = b
        presence, negligible = (chain.presence, NEGLIGIBLE) if closed is None else (None, 0.0)
        smoothed = smooth(model.chain, b, chain.prior, presence, negligible)
        chain.locate(smoothed.marginal, model.looks, model.chain.rates)
        chain.existence_likelihood = smoothed.existence_likelihood
        if model.likelihood == "cell":
            chain.marginal = smoothed.marginal
        established = chain.label > 0
        whole = 0.0 if established else model.evidence
        piece = 0.0 if established else model.evidence_of_piece
        chain.test_existence(model.switching, model.bridged, piece, whole, model.farthest)

    def _row(self, chain: TrackHypothesis) -> Array:
        scores = self.model.scores
        power, variance = scores.evaluate(self.whitened, self.explained([chain]), scores.template(chain.mixture))
        if chain.expected is None:
            return unknown_power(power, variance)
        return known_power(power, variance, chain.expected, self.model.power_spread)

    def _cells(self, chain: TrackHypothesis) -> Array:
        b = cell_likelihood(self.rows)
        # A chain recalled from the last row holds nothing before its turn.
        others = [c for c in self.chains if c is not chain and len(c.marginal)]
        if not others:
            return b
        beams = len(self.model.looks)
        return exclude(b, [occupancy(c.marginal, c.presence, beams, self.model.spread_beams) for c in others])


@njit(cache=True, nogil=True)
def _running_median(values, use):  # type: ignore[no-untyped-def]
    """Median of the used values around each row; of all of them where fewer than three are near."""
    out = np.zeros(len(values))
    every = values[use]
    if len(every) > 0:
        out[:] = np.median(every)
    for k in range(len(values)):
        low, high = max(0, k - AROUND), k + AROUND + 1
        chosen = values[low:high][use[low:high]]
        if len(chosen) >= 3:
            out[k] = np.median(chosen)
    return out
