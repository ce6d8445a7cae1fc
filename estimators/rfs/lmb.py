"""Labeled multi-Bernoulli filter (Reuter, Vo, Vo and Dietmayer 2014) under hidden and pairwise Markov models.

A target has its identity from its birth, as a Bernoulli track of its own, whether it was detected or not: there is no
Poisson part. Loopy belief propagation gives the marginals of the data association (Kropfreiter, Meyer and Hlawatsch
2019) in place of the delta-GLMB update and its marginals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks, predict_with_births
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.capacity import tracks_outgrew
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.interacting_kernel import ONE_MODE
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, scratch_mixture
from servotrack.estimators.rfs.pmb import PMBState
from servotrack.estimators.rfs.pmb_kernel import Prediction, Tally, empty_tally, update_pmb
from servotrack.estimators.rfs.recursion import GaussianSetFilter, check_positive_definite
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels


class LMBState(NamedTuple):
    """State of an `LMB`.

    Attributes:
        tracks: The posterior tracks, those of targets not yet detected too.
        pool: Components of the tracks.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
    """

    tracks: Tracks
    pool: Mixture
    births: BirthMixture
    next_label: Labels


@dataclass(frozen=True, eq=False)
class LMB(GaussianSetFilter[LMBState]):
    """Labeled multi-Bernoulli filter; arguments as in `GaussianSetFilter`.

    Every birth becomes a track of its own at every scan, with its weight as the probability of existence, at most 1.
    At a site where many scans pass without a target, `PMB` is the cheaper choice: it adds such births up.
    """

    reduction: Reduction = field(default_factory=lambda: Reduction(components=5))

    def _empty(self, batch: int, capacity: int | None = None) -> LMBState:
        capacity = capacity or self.reduction.first_tracks
        pool = empty_mixture(batch, self.reduction.pool_rows(capacity), sum(self._sizes))
        return LMBState(empty_tracks(batch, capacity), pool, self._no_births(batch), np.ones(batch, np.int64))

    def _advance(self, state: LMBState, births: BirthMixture, scan: Scan) -> tuple[LMBState, Extraction, Array]:
        (batch, capacity), (n, m) = state.tracks.existence.shape, self._sizes
        copies, arrivals = 1 + len(self.spawn), births.weight.shape[1]
        tracks = empty_tracks(batch, capacity * copies + arrivals)
        pool = scratch_mixture(batch, state.pool.weight.shape[1] * copies + arrivals, n + m)
        survival = self._evaluate("survival", self.survival, state.pool)
        predict_with_births(self.model.packed, state.tracks, state.pool, births, self._spawns, survival, tracks, pool)
        self._attach(pool)
        rows = np.arange(tracks.label.shape[1])
        new_born = (tracks.label == 0) & (rows < tracks.number[:, None])
        tracks.label[new_born] = (state.next_label[:, None] + rows)[new_born]
        following = state.next_label + tracks.number
        hidden = empty_mixture(batch, 1, n + m)
        prediction = Prediction(
            tracks, pool, hidden, self._evaluate("detection", self.detection, pool), np.zeros((batch, 1))
        )
        new, tally = self._updated(following, prediction, scan, capacity)
        while tracks_outgrew(self.reduction, new.tracks, new.pool):
            capacity *= 2
            new, tally = self._updated(following, prediction, scan, capacity)
        extraction = empty_extraction(batch, capacity, n)
        extract_tracks(n, new.tracks, new.pool, new.next_label, RULES[self.extraction], self.threshold, extraction)
        return new._replace(births=state.births), extraction, tally.unexplained

    def _updated(self, next_label: Labels, prediction: Prediction, scan: Scan, capacity: int) -> tuple[LMBState, Tally]:
        """Update into arrays with room for `capacity` tracks."""
        batch, N = len(scan.number), sum(self._sizes)
        new = self._empty(batch, capacity)._replace(next_label=next_label.copy())
        target = PMBState(new.tracks, new.pool, empty_mixture(batch, 1, N), new.births, new.next_label)
        tally = empty_tally(scan, prediction.tracks, new.tracks)
        limits = self.reduction.limits
        check_positive_definite(
            update_pmb(self.model.packed, prediction, scan, self._gate, limits, ONE_MODE, target, tally)
        )
        return new, tally
