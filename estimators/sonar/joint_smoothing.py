"""Joint smoothing of several chains in one record: each chain sees the rows minus the power explained by the others."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.hmm.exclusion import exclude, occupancy
from servotrack.estimators.hmm.smoothing import smooth
from servotrack.estimators.sonar.background import prepare_rows
from servotrack.estimators.sonar.beam_patterns import PowerFit, add_pattern, variance_of
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.crossings import resolve_crossings
from servotrack.estimators.sonar.likelihood import cell_likelihood, known_power, unknown_power
from servotrack.estimators.types import Array, Mask


class JointSmoother:
    """Search and joint smoothing of the chains in normalized rows.

    Args:
        model: Parameters and tables of the tracker.
        rows: Normalized beam powers; rows of NaN are missing. Shape (T, beams).
        chains: Existing chains.
        online: More rows may follow the last one.
    """

    def __init__(
        self, model: BearingModel, rows: Array, chains: Sequence[TrackHypothesis] = (), online: bool = False
    ) -> None:
        self.model = model
        self.online = online
        self.rows, self.background, self.missing, self.lifted = prepare_rows(rows, model.beam_width, model.backgrounds)
        self.chains = list(chains)

    @cached_property
    def whitened(self) -> Array:
        """Whitened rows without the mean noise, the input of the matched filter. Shape (T, beams)."""
        return self.model.scores.whiten(self.rows - 1.0)

    def relevel(self) -> Array | None:
        """Normalize the rows by the noise that the targets leave, if the sidelobes of loud ones have lifted the level.

        The noise level of a single row is a truncated mean over its beams, which all hold sidelobes of a loud target.
        The known beam patterns of the chains tell them from noise.

        Returns:
            Level of each row before, relative to 1; None if the rows keep their level. Shape (T,).
        """
        rules = self.model.backgrounds
        used = ~(self.missing | self.lifted)
        if not self.chains or not used.any():
            return None
        level = np.median((self.rows - self.explained()) / self.background, axis=1) + 1.0
        typical = float(np.median(level[used]))
        # Chains that explain all power up to rounding leave no noise whose level could be measured.
        rounding = float(np.finfo(np.float64).eps * np.abs(self.rows).max())
        if abs(typical - 1.0) <= rules.level_tolerance or typical <= rounding:
            return None
        level = np.where(self.missing, typical, np.maximum(level, 0.5 * min(typical, 1.0)))
        self.rows = self.rows / level[:, None]
        self.__dict__.pop("whitened", None)
        for chain in self.chains:
            chain.power = chain.power / level
            chain.expected = None if chain.expected is None else chain.expected / level
        return level

    def search(self, attempts: int) -> None:
        """Start chains on the strongest unexplained ridge until the test of existence fails `attempts` times in a row.

        A new chain is solved together with a few neighbors, so that the number of solves grows linearly with the number
        of targets. When no more chains are found, all chains are solved again, and the search continues on the
        remaining power. A chain that only replaces another one counts as failed; otherwise the two would displace each
        other without end.

        Args:
            attempts: Number of consecutive failures that ends the search. Larger values find more weak targets and are
                slower.
        """
        rules = self.model.search
        failed, settled = 0, True
        shape = len(self.rows), len(self.model.grid_bearings)
        closed, taken = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
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
            about = (
                np.abs(self.model.directions.difference(self.model.grid_bearings, ridge[:, None])) < rules.skip_distance
            )
            if chain.spans and not self._followed_already(chain):
                there = chain.presence > rules.min_presence
                self.chains.append(chain)
                self._explain(chain)
                chain.power = np.full(len(self.rows), 0.0)
                settled &= self._settle(chain)
                unexplained = None
                if not settled:
                    # Power that the other chains leave on this ridge before they are solved again is no further target.
                    taken |= about & there[:, None]
            if len(self.chains) > before:
                failed = 0
            else:
                failed += 1
                closed |= about

    def conclude(self) -> None:
        """Resolve crossings in a whole record, and search the remaining power if identities changed."""
        if self.resolve_crossings():
            self.search(attempts=2)

    def _settle(self, new: TrackHypothesis) -> bool:
        """Solve a new chain and the chains that it meets most, in turns; return True if these are all chains.

        The first chain needs only one sweep. A chain that converges onto another chain's path is removed.
        """
        # With single cells the power of a cell cannot be divided, so all chains are solved again.
        some = list(self.chains) if self.model.likelihood == "cell" else [new, *self._most_met(new)]
        everything = len(some) == len(self.chains)
        self.sweep(1 if len(self.chains) == 1 else self.model.sweeps, some)
        if not everything and new in self.chains and self._followed_already(new):
            self.chains.remove(new)
            self.fit()
        return everything

    def _most_met(self, new: TrackHypothesis) -> list[TrackHypothesis]:
        """Other chains that are near a new one in most rows, or else the nearest ones; at most `search.neighbors`."""
        rules = self.model.search

        def met(chain: TrackHypothesis) -> tuple[float, float]:
            both = (chain.presence > rules.min_presence) & (new.presence > rules.min_presence)
            apart = self.model.directions.apart(chain.bearings[both], new.bearings[both])
            return float(np.maximum(0.0, 1.0 - apart / rules.meeting_distance).sum()), -float(apart.min(initial=2.0))

        others = [chain for chain in self.chains if chain is not new]
        return sorted(others, key=met)[-rules.neighbors :]

    def _followed_already(self, new: TrackHypothesis) -> bool:
        """Return True if a chain follows the path of another one in most of its rows: both are one target."""
        rules = self.model.search
        rows = slice(new.spans[0].first, new.spans[0].last + 1)

        def merged(chain: TrackHypothesis) -> bool:
            away = self.model.directions.difference(chain.bearings[rows], new.bearings[rows])
            near = np.abs(away) < rules.merge_distance
            return bool(np.mean(near & (chain.presence[rows] > rules.min_presence)) > 0.5)

        return any(merged(chain) for chain in self.chains if chain is not new)

    def sweep(self, times: int, some: Sequence[TrackHypothesis] | None = None) -> None:
        """Solve chains in turn, given the others; remove those that fail the test of existence.

        Args:
            times: Number of turns.
            some: Chains to solve; None: all.
        """
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
        """Undo exchanges of targets between chains at crossings; return True if there were any."""
        if self.model.likelihood == "cell":
            return False
        changed = False
        for _ in range(self.model.search.max_exchanges):
            others = [self.explained([chain]) for chain in self.chains]
            if not resolve_crossings(
                self.chains,
                self.model.patterns,
                self.rows,
                others,
                self.model.beam_bearings,
                self.model.crossing,
                self.model.directions,
            ):
                break
            changed = True
            for chain in self.chains:
                self._explain(chain)
            self.sweep(1)
        return changed

    def explained(self, but: Sequence[TrackHypothesis] = ()) -> Array:
        """Mean beam powers by noise and all chains except those in `but`. Shape (T, beams)."""
        mean = self.background.copy()
        for chain in self.chains:
            if chain not in but:
                add_pattern(mean, chain.presence * chain.power, chain.pattern)
        return mean

    def fit(self, some: Sequence[TrackHypothesis] | None = None) -> None:
        """Fit powers, expected powers and spectra of some chains together (None: all); the others stay unchanged."""
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
            powers = PowerFit.of(excess, patterns, there, variance, model.patterns.shared_beams)
            free = powers.powers(*unknown)
            usual = np.array(
                [_running_median(p, use, model.search.median_rows) for p, use in zip(free, alone, strict=True)]
            )
            usual = np.maximum(usual, least)
            power = powers.powers(usual, model.power_spread * usual)
            for i, chain in enumerate(chains):
                chain.expected = usual[i]
                seen = (there[i] > model.search.min_presence) & ~self.missing
                chain.power = np.where(seen, power[i], usual[i])
            mean = self.explained()
        for chain, use in zip(chains, alone, strict=True):
            if use.sum() >= model.search.min_spectrum_rows:
                left = (self.rows - self.explained([chain]))[use]
                chain.mixture = model.patterns.fit(
                    left, variance[use], model.beam_bearings, chain.bearings[use], np.maximum(chain.power[use], least)
                )

    def _alone(self, chain: TrackHypothesis) -> Mask:
        """Mask of the rows in which a chain's target exists and is resolved from all others."""
        rules = self.model.search
        alone = (chain.presence > rules.min_presence) & ~(self.missing | self.lifted)
        for other in self.chains:
            if other is not chain:
                apart = self.model.directions.apart(chain.bearings, other.bearings)
                alone &= ~((other.presence > rules.min_presence) & (apart < rules.resolution))
        return alone

    def _explain(self, chain: TrackHypothesis) -> None:
        if self.model.likelihood == "row":
            beam_bearings = self.model.beam_bearings
            chain.pattern = self.model.patterns.at(chain.mixture, beam_bearings, chain.bearings)

    def _likelihood(self, chain: TrackHypothesis) -> Array:
        b = self._cells(chain) if self.model.likelihood == "cell" else self._row(chain)
        if self.lifted.any():
            ratio = np.log(b[self.lifted])
            limit = self.model.backgrounds.max_log_ratio
            top = np.maximum(ratio.max(axis=1, keepdims=True), limit)
            b[self.lifted] = np.exp(ratio * (limit / top))
        b[self.missing] = 1.0
        return b

    def _smooth(self, chain: TrackHypothesis, b: Array, closed: Mask | None = None) -> None:
        """Smooth one chain and test its existence.

        Args:
            chain: Chain to solve; its estimates are replaced.
            b: Likelihood ratios of the rows. Shape (T, W).
            closed: Cells that a new chain must avoid; None for an established chain. Shape (T, beams).
        """
        model = self.model
        if closed is not None and closed.any():
            b = np.where(np.tile(closed, (1, b.shape[1] // closed.shape[1])), 1.0, b)
        chain.likelihood = b
        presence, negligible = (chain.presence, model.search.negligible) if closed is None else (None, 0.0)
        # A band of bearings that is cut off has no meaning on a circle.
        cut = 0.0 if model.directions.circle else negligible
        smoothed = smooth(model.chain, b, chain.prior, presence, cut)
        directions = model.directions
        chain.locate(smoothed.marginal, model.grid_bearings, model.chain.rates, model.spans.mode_width, directions)
        chain.existence_likelihood = smoothed.existence_likelihood
        if model.likelihood == "cell":
            chain.marginal = smoothed.marginal
        established = chain.label > 0
        chain.test_existence(
            model.switching,
            model.bridge_rows,
            0.0 if established else model.evidence_of_piece,
            0.0 if established else model.evidence,
            model.max_step,
            model.spans,
            directions,
            self.online,
        )

    def _row(self, chain: TrackHypothesis) -> Array:
        scores = self.model.scores
        power, variance = scores.evaluate(self.whitened, self.explained([chain]), scores.template(chain.mixture))
        if chain.expected is None:
            return unknown_power(power, variance, self.model.likelihood_rules)
        return known_power(power, variance, chain.expected, self.model.power_spread, self.model.likelihood_rules)

    def _cells(self, chain: TrackHypothesis) -> Array:
        b = self.model.on_grid(cell_likelihood(self.rows / self.background, self.model.likelihood_rules))
        # A chain recalled from the last row occupies no cells before it is solved.
        others = [c for c in self.chains if c is not chain and len(c.marginal)]
        if not others:
            return b
        positions = len(self.model.grid_bearings)
        return exclude(b, [occupancy(c.marginal, c.presence, positions, self.model.spread_beams) for c in others])


@njit(cache=True, nogil=True)
def _running_median(values, use, reach):  # type: ignore[no-untyped-def]
    """Median of the used values within `reach` rows, or of all used values if fewer than three are near."""
    out = np.zeros(len(values))
    every = values[use]
    if len(every) > 0:
        out[:] = np.median(every)
    for k in range(len(values)):
        low, high = max(0, k - reach), k + reach + 1
        chosen = values[low:high][use[low:high]]
        if len(chosen) >= 3:
            out[k] = np.median(chosen)
    return out
