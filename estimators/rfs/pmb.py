"""Track-oriented Poisson multi-Bernoulli filter (Williams 2015) with labels, under hidden and pairwise Markov models.

Targets that were never detected are a Poisson intensity; each detected target is a Bernoulli track with an identity.
Loopy belief propagation gives the marginals of the data association, and a track keeps the mixture of its hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.interacting_kernel import ONE_MODE
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture
from servotrack.estimators.rfs.pmb_kernel import Prediction, Tally, empty_tally, update_pmb
from servotrack.estimators.rfs.poisson_tracks import PoissonTrackFilter
from servotrack.estimators.rfs.recursion import check_positive_definite
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels


class PMBState(NamedTuple):
    """State of a `PMB`.

    Attributes:
        tracks: Tracks of targets detected at least once.
        pool: Components of the tracks.
        undetected: Intensity of targets never detected.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
    """

    tracks: Tracks
    pool: Mixture
    undetected: Mixture
    births: BirthMixture
    next_label: Labels


@dataclass(frozen=True, eq=False)
class PMB(PoissonTrackFilter[PMBState]):
    """Poisson multi-Bernoulli filter; further arguments as in `GaussianSetFilter`.

    Args:
        undetected: Largest number of components of the intensity of undetected targets; a step in which it removes
            targets warns. None: no limit; arrays have room for 100 and double when targets would be lost.
    """

    reduction: Reduction = field(default_factory=lambda: Reduction(components=5))

    def _empty(self, batch: int) -> PMBState:
        capacity, hidden = self.reduction.first_tracks, self._first_undetected
        return self._with_room(batch, capacity, hidden, self._no_births(batch), np.ones(batch, np.int64))

    def _with_room(self, batch: int, capacity: int, hidden: int, births: BirthMixture, next_label: Labels) -> PMBState:
        """State without targets, with room for `capacity` tracks and `hidden` components of undetected targets."""
        N = sum(self._sizes)
        return PMBState(
            empty_tracks(batch, capacity),
            empty_mixture(batch, self.reduction.pool_rows(capacity), N),
            empty_mixture(batch, hidden, N),
            births,
            next_label,
        )

    def _advance(self, state: PMBState, births: BirthMixture, scan: Scan) -> tuple[PMBState, Extraction, Array]:
        prediction = self._predict(state, state.tracks.existence, births)
        new, tally = self._fitted(
            lambda capacity, hidden: self._updated(state, prediction, scan, capacity, hidden), state, prediction
        )
        batch, capacity = new.tracks.existence.shape
        extraction = empty_extraction(batch, capacity, self._sizes[0])
        rule = RULES[self.extraction]
        extract_tracks(self._sizes[0], new.tracks, new.pool, new.next_label, rule, self.threshold, extraction)
        expected = extraction.expected + new.undetected.weight.sum(axis=1)
        return new, extraction._replace(expected=expected), tally.unexplained

    def _updated(
        self, state: PMBState, prediction: Prediction, scan: Scan, capacity: int, hidden: int
    ) -> tuple[PMBState, Tally]:
        """Update into arrays with room for `capacity` tracks and `hidden` components of undetected targets."""
        new = self._with_room(len(scan.number), capacity, hidden, state.births, state.next_label.copy())
        tally = empty_tally(scan, state.tracks, new.tracks)
        limits = self.reduction.limits
        check_positive_definite(
            update_pmb(self.model.packed, prediction, scan, self._gate, limits, ONE_MODE, new, tally)
        )
        return new, tally
