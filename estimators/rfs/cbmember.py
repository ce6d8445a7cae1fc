"""Gaussian-mixture CBMeMBer filter (Vo, Vo and Cantoni 2009), also under pairwise Markov models (Zhang et al. 2017)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.bernoulli import (
    Tracks,
    empty_tracks,
    normalize,
    owners_and_detection,
    predict_with_births,
    rows_by_key,
)
from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.capacity import tracks_outgrew
from servotrack.estimators.rfs.extraction import RULES, extract_tracks
from servotrack.estimators.rfs.gaussians import detected_mean, weigh_pairs
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, scratch_mixture
from servotrack.estimators.rfs.recursion import GaussianSetFilter, check_positive_definite
from servotrack.estimators.rfs.reduction import Candidates, Components, Reduction, reduce_mixture
from servotrack.estimators.rfs.sets import Extraction, Scan, empty_extraction
from servotrack.estimators.types import Array, Labels


class CBMeMBerState(NamedTuple):
    """State of a `GMCBMeMBer`.

    Attributes:
        tracks: The posterior tracks.
        pool: Components of the tracks.
        births: Births at the last measurements if they depend on them, else empty.
        next_label: The next new identity. Shape (*batch,).
    """

    tracks: Tracks
    pool: Mixture
    births: BirthMixture
    next_label: Labels


@dataclass(frozen=True, eq=False)
class GMCBMeMBer(GaussianSetFilter[CBMeMBerState]):
    """Cardinality-balanced multi-target multi-Bernoulli filter; further arguments as in `GaussianSetFilter`.

    Args:
        balanced: False selects the MeMBer update without balancing, which over-estimates the number of targets.
        largest_existence: Upper limit of a track's existence r in r / (1 - r), in (0, 1). Raising it lets certain
            tracks dominate the components of a measurement more.

    Raises:
        ValueError: `largest_existence` or an argument of `GaussianSetFilter` is out of range.
    """

    reduction: Reduction = field(default_factory=lambda: Reduction(components=10))
    balanced: bool = True
    largest_existence: float = 0.999

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.largest_existence < 1.0:
            raise ValueError(f"largest_existence must be in (0, 1), got {self.largest_existence!r}")

    def _empty(self, batch: int, capacity: int | None = None) -> CBMeMBerState:
        capacity = capacity or self.reduction.first_tracks
        pool = empty_mixture(batch, self.reduction.pool_rows(capacity), sum(self._sizes))
        return CBMeMBerState(empty_tracks(batch, capacity), pool, self._no_births(batch), np.ones(batch, np.int64))

    def _advance(
        self, state: CBMeMBerState, births: BirthMixture, scan: Scan
    ) -> tuple[CBMeMBerState, Extraction, Array]:
        model, (batch, capacity) = self.model.packed, state.tracks.existence.shape
        n, m = self._sizes
        copies, arrivals = 1 + len(self.spawn), births.weight.shape[1]
        predicted = empty_tracks(batch, capacity * copies + arrivals)
        components = scratch_mixture(batch, state.pool.weight.shape[1] * copies + arrivals, n + m)
        survival = self._evaluate("survival", self.survival, state.pool)
        predict_with_births(model, state.tracks, state.pool, births, self._spawns, survival, predicted, components)
        self._attach(components)
        new, unexplained = self._updated(state, predicted, components, scan, capacity)
        while tracks_outgrew(self.reduction, new.tracks, new.pool):
            capacity *= 2
            new, unexplained = self._updated(state, predicted, components, scan, capacity)
        extraction = empty_extraction(batch, capacity, n)
        extract_tracks(n, new.tracks, new.pool, new.next_label, RULES[self.extraction], self.threshold, extraction)
        return new._replace(births=state.births), extraction, unexplained

    def _updated(
        self, state: CBMeMBerState, predicted: Tracks, components: Mixture, scan: Scan, capacity: int
    ) -> tuple[CBMeMBerState, Array]:
        """Update into arrays with room for `capacity` tracks."""
        new = self._empty(len(scan.number), capacity)._replace(next_label=state.next_label.copy())
        unexplained = np.zeros(scan.clutter.shape)
        positive_definite = _update(
            self.model.packed,
            predicted,
            components,
            scan,
            self._evaluate("detection", self.detection, components),
            self._gate,
            self.reduction.limits,
            (self.balanced, float(self.largest_existence)),
            new.next_label,
            new.tracks,
            new.pool,
            unexplained,
        )
        check_positive_definite(positive_definite)
        return new, unexplained


@njit(cache=True, nogil=True)
def _update(  # type: ignore[no-untyped-def]
    model, tracks, pool, scan, detection, gate, limits, form, next_label, out_tracks, out_pool, unexplained
):
    """Posterior tracks of every run: legacy tracks, and one per measurement (Vo et al. 2009, eqs 12 to 19).

    `form` is the pair of `balanced` and `largest_existence`.
    """
    m, n = model.observation.shape
    z, number, clutter, excess = scan
    balanced, largest_existence = form
    prune, cap, least = limits.prune, limits.components, limits.existence
    innovation = np.empty(m)
    positive_definite = True
    for b in range(tracks.existence.shape[0]):
        count, T, Z = pool.number[b], tracks.number[b], number[b]
        component, measurement, likelihood, part, gain, posterior, definite = weigh_pairs(
            model, count, pool.mean[b], pool.covariance[b], z[b], excess[b], Z, gate
        )
        positive_definite = positive_definite and definite
        pairs = component.shape[0]
        owner, detectable = owners_and_detection(tracks, pool, detection, b)
        existence = np.empty(T + Z)
        label = np.zeros(T + Z, np.int64)
        r = np.empty(T)
        for i in range(T):
            r[i] = min(tracks.existence[b, i], largest_existence)
            existence[i] = r[i] * (1.0 - detectable[i]) / (1.0 - r[i] * detectable[i])
            label[i] = tracks.label[b, i]
        weight = np.empty(count + pairs)
        mean = np.empty((count + pairs, n + m))
        source = np.empty(count + pairs, np.int64)
        group = np.empty(count + pairs, np.int64)
        for c in range(count):
            i = owner[c]
            missed = 1.0 - detectable[i]
            weight[c] = pool.weight[b, c] * (1.0 - detection[b, c]) / missed if missed > 0.0 else 0.0
            source[c], group[c] = c, -1
            # Components that the reduction drops need no mean.
            if weight[c] > prune and existence[i] >= least:
                for k in range(n + m):
                    mean[c, k] = pool.mean[b, c, k]
        numerator = np.zeros(Z)
        evidence = clutter[b, :Z].copy()
        density = np.zeros(Z)
        heaviest = np.zeros(Z)
        for p in range(pairs):
            c, j = component[p], measurement[p]
            i = owner[c]
            rho = detection[b, c] * pool.weight[b, c] * likelihood[p]
            absent = 1.0 - r[i] * detectable[i]
            evidence[j] += r[i] * rho / absent
            numerator[j] += r[i] * (1.0 - r[i]) * rho / (absent * absent) if balanced else r[i] * rho / absent
            weight[count + p] = r[i] / (1.0 - r[i]) * rho
            density[j] += weight[count + p]
            source[count + p], group[count + p] = part[p], j
            if weight[count + p] > heaviest[j]:
                heaviest[j] = weight[count + p]
                label[T + j] = label[i] if label[i] > 0 else next_label[b] + j
        next_label[b] += Z
        for j in range(Z):
            existence[T + j] = min(numerator[j] / evidence[j], 1.0) if evidence[j] > 0.0 else 0.0
            unexplained[b, j] = clutter[b, j] / evidence[j] if evidence[j] > 0.0 else 1.0
        for p in range(pairs):
            c, j = component[p], measurement[p]
            weight[count + p] = weight[count + p] / density[j] if density[j] > 0.0 else 0.0
            if weight[count + p] > prune and existence[T + j] >= least:
                detected_mean(model, pool.mean[b, c], gain[part[p]], z[b, j], innovation, mean[count + p])
        key = np.empty(count + pairs, np.int64)
        key[:count] = owner
        key[count:] = T + measurement
        rows, start = rows_by_key(key, T + Z)
        candidates = Candidates(weight, mean, source, group, np.zeros(count + pairs, np.int64))
        room = Components(
            out_pool.weight[b], out_pool.mean[b], out_pool.covariance[b], out_pool.detected[b], out_pool.label[b]
        )
        track = 0
        filled = 0
        for t in np.argsort(-existence, kind="mergesort"):
            if existence[t] < least or existence[t] <= 0.0 or track == out_tracks.existence.shape[1]:
                break
            members = rows[start[t] : start[t + 1]]
            most = min(cap, room.weight.shape[0] - filled)
            size = reduce_mixture(
                model.pairwise, n, candidates, members, pool.covariance[b], posterior, limits, most, room, filled
            )
            if size == 0:
                continue
            normalize(room.weight, filled, size)
            out_tracks.existence[b, track] = existence[t]
            out_tracks.label[b, track] = label[t]
            out_tracks.size[b, track] = size
            track += 1
            filled += size
        out_tracks.number[b] = track
        out_pool.number[b] = filled
    return positive_definite
