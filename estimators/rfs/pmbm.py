"""Poisson multi-Bernoulli mixture filter with labels, under hidden and pairwise Markov models.

The exact posterior of the standard multi-target models is a Poisson multi-Bernoulli mixture (Williams 2015, "Marginal
multi-Bernoulli filters"; Garcia-Fernandez, Williams, Granstrom and Svensson 2018, "Poisson multi-Bernoulli mixture
filter: direct derivation and implementation"): an intensity of undetected targets, and global hypotheses, each with a
weight and one Bernoulli per track. Nothing but pruning approximates it, which makes this filter the yardstick of `PMB`,
its projection after every scan.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from servotrack.estimators.rfs.bernoulli import Tracks, empty_tracks
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.hypotheses import Hypotheses, Ranking, empty_hypotheses
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, scratch_mixture
from servotrack.estimators.rfs.pmbm_kernel import update_pmbm
from servotrack.estimators.rfs.poisson_tracks import PoissonTrackFilter
from servotrack.estimators.rfs.projection import keep_identities, project
from servotrack.estimators.rfs.recursion import check_positive_definite
from servotrack.estimators.rfs.reduction import Limits, Reduction
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import check_count, checked_number


class PMBMState(NamedTuple):
    """State of a `PMBM`.

    Attributes:
        hypotheses: The global hypotheses.
        tracks: Bernoullis of all hypotheses; those that start with the same detection have the same label.
        identity: Reported identity of each Bernoulli: its label, or the identity of the recycled Bernoulli that
            probably caused its first detection. Shape (*batch, T).
        share: Probability of the global hypotheses that contain each Bernoulli. Shape (*batch, T).
        pool: Components of the Bernoullis.
        undetected: Intensity of undetected targets, recycled Bernoullis included.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
        cut: Probability that the caps removed in the last scan: hypotheses, Bernoullis and components. Shape (*batch,).
        cut_undetected: Expected number of targets that the cap `undetected` removed in the last scan. Shape (*batch,).
    """

    hypotheses: Hypotheses
    tracks: Tracks
    identity: Labels
    share: Array
    pool: Mixture
    undetected: Mixture
    births: BirthMixture
    next_label: Labels
    cut: Array
    cut_undetected: Array


class Projection(NamedTuple):
    """Tracks of a multi-Bernoulli distribution.

    Attributes:
        tracks: Existence and reported identity of each track.
        pool: Components of the tracks; the y parts are dropped.
    """

    tracks: Tracks
    pool: Mixture


@dataclass(frozen=True, eq=False)
class PMBM(PoissonTrackFilter[PMBMState]):
    """Poisson multi-Bernoulli mixture filter; further arguments as in `GaussianSetFilter`.

    `reduction.tracks` limits the Bernoullis of all hypotheses together, and `reduction.components` the components of
    each. The expected number of an estimate includes undetected targets.

    Args:
        undetected: Largest number of components of the intensity of undetected targets. Raising it costs time.
        assignments: Associations ranked per scan, divided among the global hypotheses in proportion to their weights.
            Raising it comes closer to the exact posterior and costs time.
        hypotheses: Largest number of global hypotheses, the heaviest. Raising it does the same.
        least_weight: Global hypotheses and associations of less probability are dropped. Raising it is faster and
            decides associations earlier.
        recycle: Bernoullis of less existence return to the undetected intensity, below 1. A recycled target that is
            detected again keeps its identity. Raising it is faster and less exact; 0 recycles none.
        targets: Largest number of Bernoullis of one global hypothesis, the most probable.
        report: "tracks" extracts from the projection to one Bernoulli per track, "hypothesis" from the heaviest global
            hypothesis.
        tolerated_cut: Probability, or expected number of undetected targets, that all caps (`hypotheses`, `targets`,
            `undetected` and those of `reduction`) may remove in one scan without a warning. Raising it warns less.

    Warns:
        UserWarning: The caps removed more than `tolerated_cut`; the state says how much.
    """

    undetected: int = 100
    reduction: Reduction = field(default_factory=lambda: Reduction(components=5, tracks=1000))
    assignments: int = 500
    hypotheses: int = 500
    least_weight: float = 1e-6
    recycle: float = 0.1
    targets: int = 100
    report: Literal["tracks", "hypothesis"] = "hypothesis"
    tolerated_cut: float = 0.1

    def __post_init__(self) -> None:
        for name in ("undetected", "assignments", "hypotheses", "targets"):
            check_count(name, getattr(self, name), 1)
        super().__post_init__()
        for name in ("least_weight", "recycle"):
            checked_number(name, getattr(self, name), 0.0, np.nextafter(1.0, 0.0), "at least 0 and below 1")
        if self.report not in ("tracks", "hypothesis"):
            raise ValueError(f'report must be "tracks" or "hypothesis", got {self.report!r}')
        checked_number("tolerated_cut", self.tolerated_cut, 0.0, np.inf, "at least 0")

    def project(self, state: PMBMState) -> Projection:
        """Project a posterior to one Bernoulli per track that keeps existence, mean and covariance.

        Args:
            state: Result of `step`.
        """
        single = np.ndim(state.next_label) == 0
        rules = self.reduction.limits._replace(prune=0.0, components=self.reduction.pool_size)
        projection, _ = self._projection(add_axis(state) if single else state, rules, heaviest=False)
        return first_row(projection) if single else projection

    def _projection(self, state: PMBMState, limits: Limits, *, heaviest: bool) -> tuple[Projection, Labels]:
        batch, capacity = state.tracks.existence.shape
        pool = scratch_mixture(batch, state.pool.weight.shape[1], sum(self._sizes))
        projection = Projection(empty_tracks(batch, capacity), pool)
        first = np.zeros((batch, capacity), np.int64)
        project(self._sizes[0], state, heaviest, float(self.threshold), limits, *projection, first)
        return projection, first

    def _empty(self, batch: int) -> PMBMState:
        rules, N = self.reduction, sum(self._sizes)
        return PMBMState(
            empty_hypotheses(batch, self.hypotheses, self.targets),
            empty_tracks(batch, rules.first_tracks),
            np.zeros((batch, rules.first_tracks), np.int64),
            np.zeros((batch, rules.first_tracks)),
            empty_mixture(batch, rules.pool_size, N),
            empty_mixture(batch, self.undetected, N),
            self._no_births(batch),
            np.ones(batch, np.int64),
            np.zeros(batch),
            np.zeros(batch),
        )

    def _advance(self, state: PMBMState, births: BirthMixture, scan: Scan) -> tuple[PMBMState, Extraction, Array]:
        model, rules, batch = self.model.packed, self.reduction, scan.number.shape[0]
        prediction = self._predict(state, state.share * state.tracks.existence, births)
        ranking = Ranking(self.assignments, float(self.least_weight), float(self.recycle), float(rules.existence))
        new = self._empty(batch)._replace(births=state.births, next_label=state.next_label.copy())
        unexplained = np.zeros(scan.clutter.shape)
        check_positive_definite(
            update_pmbm(model, prediction, state, scan, self._gate, rules.limits, ranking, new, unexplained)
        )
        self._warn(new)
        n = self._sizes[0]
        (tracks, pool), first = self._projection(new, rules.limits, heaviest=self.report == "hypothesis")
        extraction = empty_extraction(batch, rules.first_tracks, n)
        extract_tracks(n, tracks, pool, new.next_label, RULES[self.extraction], self.threshold, extraction)
        keep_identities(tracks, first, new)
        expected = (new.share * new.tracks.existence).sum(axis=1) + new.undetected.weight.sum(axis=1)
        return new, extraction._replace(expected=expected), unexplained

    def _warn(self, state: PMBMState) -> None:
        """Warn if the caps removed too much, in words that are the same every time so that Python shows them once."""
        if float(state.cut.max()) > self.tolerated_cut:
            warnings.warn(
                f"caps removed a probability of more than {self.tolerated_cut:g} in one scan (state.cut); raise "
                "hypotheses, targets, or components, tracks and pool of reduction",
                UserWarning,
                stacklevel=4,
            )
        if float(state.cut_undetected.max()) > self.tolerated_cut:
            warnings.warn(
                f"the cap on undetected removed more than {self.tolerated_cut:g} expected targets in one scan "
                "(state.cut_undetected); raise undetected",
                UserWarning,
                stacklevel=4,
            )
