"""Pruning, merging and capping of Gaussian mixtures (Vo and Ma 2006, table II; the spread of the means is kept).

Components of a pairwise model come in two kinds after an update: a missed one is a Gaussian over (x, y), a detected
one a Gaussian over x with y equal to its measurement. Missed components merge in (x, y), detected ones in x and only
with those of the same measurement. Under a hidden Markov model y is dropped and all components merge in x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels, Mask


class Limits(NamedTuple):
    """Numbers of a `Reduction` for the compiled kernels; attributes as there."""

    prune: float
    merge: float
    components: int
    existence: float
    candidates: int


class Candidates(NamedTuple):
    """Components of one run before reduction.

    Attributes:
        weight: Weights. Shape (C,).
        mean: Means. Shape (C, N).
        source: Row of the component's covariance. Shape (C,).
        group: Index of the measurement, or -1 for a missed component. Shape (C,).
        label: Identity, 0 for none. Shape (C,).
    """

    weight: Array
    mean: Array
    source: Labels
    group: Labels
    label: Labels


class Components(NamedTuple):
    """Output arrays for the components of one run, as in `Mixture`.

    Attributes:
        weight: Weights. Shape (K,).
        mean: Means. Shape (K, N).
        covariance: Covariances. Shape (K, N, N).
        detected: Mask of components whose y is known exactly or dropped. Shape (K,).
        label: Identity, 0 for none. Shape (K,).
    """

    weight: Array
    mean: Array
    covariance: Array
    detected: Mask
    label: Labels


@dataclass(frozen=True)
class Reduction:
    """Parameters of the reduction of a mixture after each update.

    Larger mixtures approximate the exact posterior better; the time of a step grows with their size.

    Args:
        prune: Components of less weight are dropped before merging (T_omega). Raising it gives smaller mixtures.
        merge: Squared Mahalanobis distance within which components merge (U). Raising it merges more; 0 merges none.
        components: Largest number of components kept, the heaviest (J_max); per track in the multi-Bernoulli filters.
            None: 100, which doubles in a filter of one intensity when targets would be lost.
        existence: Tracks of less probability are dropped (T_r); multi-Bernoulli filters only. Raising it ends
            tracks sooner.
        tracks: Largest number of tracks kept, the most probable (T_max); multi-Bernoulli filters only. None: no limit;
            arrays have room for 100 tracks and double when they are full.
        pool: Largest number of components of all tracks, those of the most probable tracks; None: three per track that
            the arrays have room for.
        candidates: Merging considers the `candidates * components` heaviest components. This limits the time where
            thousands of measurements coincide; raising it loses less of the light components.

    Raises:
        ValueError: An argument is out of range.
    """

    prune: float = 1e-5
    merge: float = 4.0
    components: int | None = 100
    existence: float = 1e-3
    tracks: int | None = None
    pool: int | None = None
    candidates: int = 10

    def __post_init__(self) -> None:
        for name, value, top in (
            ("prune", self.prune, 1.0),
            ("existence", self.existence, 1.0),
            ("merge", self.merge, np.inf),
        ):
            if not 0.0 <= value < top:
                raise ValueError(f"{name} must be at least 0 and below {top}, got {value!r}")
        for name, count in (
            ("components", self.first_components),
            ("tracks", self.first_tracks),
            ("pool", self.pool_size),
            ("candidates", self.candidates),
        ):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count!r}")

    @property
    def first_components(self) -> int:
        """Components for which the first arrays have room."""
        return 100 if self.components is None else self.components

    @property
    def first_tracks(self) -> int:
        """Tracks for which the first arrays have room."""
        return 100 if self.tracks is None else self.tracks

    @property
    def pool_size(self) -> int:
        """Components of all tracks for which the first arrays have room."""
        return self.pool_rows(self.first_tracks)

    def pool_rows(self, tracks: int) -> int:
        """Components of all tracks in arrays with room for so many tracks."""
        return 3 * tracks if self.pool is None else self.pool

    @cached_property
    def limits(self) -> Limits:
        """Numbers for the compiled kernels."""
        return Limits(
            float(self.prune),
            float(self.merge),
            int(self.first_components),
            float(self.existence),
            int(self.candidates),
        )


@njit(cache=True, nogil=True)
def squared_distance(difference, cov, size, limit, root):  # type: ignore[no-untyped-def]
    """Compute difference^T cov^-1 difference, or infinity once it exceeds the limit or cov is not definite."""
    # d^2 is at least the square of each entry over its variance; most pairs end here.
    for r in range(size):
        if difference[r] * difference[r] > limit * cov[r, r]:
            return np.inf
    total = 0.0
    for r in range(size):
        solved = difference[r]
        for c in range(r + 1):
            value = cov[r, c]
            for k in range(c):
                value -= root[r, k] * root[c, k]
            if r > c:
                root[r, c] = value / root[c, c]
                solved -= root[r, c] * root[c, size]
            elif value > 0.0:
                root[r, r] = np.sqrt(value)
            else:
                return np.inf
        # The last column holds the forward substitution.
        root[r, size] = solved / root[r, r]
        total += root[r, size] * root[r, size]
        if total > limit:
            return np.inf
    return total


@njit(cache=True, nogil=True)
def reduce_mixture(  # type: ignore[no-untyped-def]
    pairwise, n, candidates, members, missed_cov, detected_cov, limits, cap, out, start, into=None
):
    """Prune, merge and cap some candidates and write the remaining components, the heaviest first.

    Args:
        pairwise: True if missed and detected components differ in kind (see above).
        n: State size.
        candidates: A `Candidates`.
        members: Rows of the candidates to reduce. Shape (k,).
        missed_cov: Covariances of missed components. Shape (J, N, N).
        detected_cov: Covariances after a detection. Shape (J, n, n).
        limits: A `Limits`, of which `prune`, `merge` and `candidates` are used.
        cap: Largest number of components written.
        out: A `Components` to write to.
        start: First row to write.
        into: Output if not None: the row that each candidate was merged into, unchanged for dropped ones. Shape (C,).

    Returns:
        Number of components written.
    """
    weight, mean, source, group, label = candidates
    out_weight, out_mean, out_cov, out_detected, out_label = out
    merge = limits.merge
    N = mean.shape[1]
    heavy = members[weight[members] > limits.prune]
    order = heavy[np.argsort(-weight[heavy], kind="mergesort")][: limits.candidates * cap]
    k = order.shape[0]
    following = np.full(k, -1, np.int32)
    taken = np.zeros(k, np.bool_)
    heads = np.empty(k, np.int32)
    totals = np.empty(k)
    difference = np.empty(N)
    root = np.empty((N, N + 1))
    # Nearly all pairs differ too much in the first entry; contiguous copies make that comparison cheap.
    first, reach = np.empty(k), np.empty(k)
    for i in range(k):
        member = order[i]
        first[i] = mean[member, 0]
        variance = missed_cov[source[member], 0, 0] if group[member] < 0 else detected_cov[source[member], 0, 0]
        reach[i] = merge * variance
    number = 0
    for h in range(k):
        if taken[h]:
            continue
        head = order[h]
        joint = pairwise and group[head] < 0
        size = N if joint else n
        total = weight[head]
        last = h
        if merge > 0.0:
            for i in range(h + 1, k):
                apart = first[i] - first[h]
                if apart * apart > reach[i] or taken[i]:
                    continue
                other = order[i]
                if pairwise and group[other] != group[head]:
                    continue
                cov = missed_cov[source[other]] if group[other] < 0 else detected_cov[source[other]]
                for r in range(size):
                    difference[r] = mean[other, r] - mean[head, r]
                if squared_distance(difference, cov, size, merge, root) <= merge:
                    taken[i] = True
                    following[last] = i
                    last = i
                    total += weight[other]
        heads[number] = h
        totals[number] = total
        number += 1
    ranking = np.argsort(-totals[:number], kind="mergesort")[:cap]
    for rank in range(ranking.shape[0]):
        h = heads[ranking[rank]]
        total = totals[ranking[rank]]
        head = order[h]
        size = N if pairwise and group[head] < 0 else n
        row = start + rank
        out_weight[row] = total
        out_detected[row] = not (pairwise and group[head] < 0)
        out_label[row] = 0
        average = out_mean[row]
        cov = out_cov[row]
        for r in range(N):
            # The y of a Dirac is its measurement; under a hidden Markov model y is dropped.
            average[r] = mean[head, r] if pairwise and r >= size else 0.0
            for c in range(N):
                cov[r, c] = 0.0
        i = h
        while i >= 0:
            member = order[i]
            if into is not None:
                into[member] = row
            if out_label[row] == 0:
                out_label[row] = label[member]
            share = weight[member] / total
            for r in range(size):
                average[r] += share * mean[member, r]
            i = following[i]
        i = h
        while i >= 0:
            member = order[i]
            share = weight[member] / total
            part = missed_cov[source[member]] if group[member] < 0 else detected_cov[source[member]]
            for r in range(size):
                spread = mean[member, r] - average[r]
                for c in range(r + 1):
                    cov[r, c] += share * (part[r, c] + spread * (mean[member, c] - average[c]))
            i = following[i]
        for r in range(size):
            for c in range(r):
                cov[c, r] = cov[r, c]
    return ranking.shape[0]
