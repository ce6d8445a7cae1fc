"""Pruning, merging and capping of Gaussian mixtures (Vo and Ma 2006, table II; the spread of the means is kept).

Components of a pairwise model come in two kinds after an update: a missed one is a Gaussian over (x, y), a detected
one a Gaussian over x with y equal to its measurement. Missed components merge in (x, y), detected ones in x and only
with those of the same measurement. Under a hidden Markov model y is forgotten and all merge in x.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

CANDIDATES_PER_COMPONENT = 10
"""Merging looks at this many times the cap, the heaviest: a bound on time where thousands of measurements coincide."""


@dataclass(frozen=True)
class Reduction:
    """How far a mixture is reduced after each update.

    Args:
        prune: Components lighter than this are dropped before merging (T_omega).
        merge: Squared Mahalanobis distance within which components merge (U); 0 merges nothing.
        components: Most components kept, the heaviest (J_max); per track in the multi-Bernoulli filters.
        existence: Tracks less probable than this are dropped (T_r); multi-Bernoulli filters only.
        tracks: Most tracks kept, the most probable (T_max); multi-Bernoulli filters only.
        pool: Most components of all tracks together, those of the most probable; None: three per track.

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    prune: float = 1e-5
    merge: float = 4.0
    components: int = 100
    existence: float = 1e-3
    tracks: int = 100
    pool: int | None = None

    def __post_init__(self) -> None:
        for name, value, top in (
            ("prune", self.prune, 1.0),
            ("existence", self.existence, 1.0),
            ("merge", self.merge, np.inf),
        ):
            if not 0.0 <= value < top:
                raise ValueError(f"{name} must be at least 0 and below {top}, got {value!r}")
        for name, count in (("components", self.components), ("tracks", self.tracks), ("pool", self.pool_size)):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count!r}")

    @property
    def pool_size(self) -> int:
        """Room for the components of all tracks."""
        return 3 * self.tracks if self.pool is None else self.pool


@njit(cache=True, nogil=True)
def _squared_distance(difference, cov, size, limit, root):  # type: ignore[no-untyped-def]
    """difference^T cov^-1 difference, or infinity as soon as it must exceed the limit or cov is not definite."""
    # d^2 is at least each entry's square over its variance: most pairs end here.
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
    pairwise, n, candidates, members, missed_cov, detected_cov, prune, merge, cap, out, start
):
    """Prune, merge and cap some candidates, writing what is left, heaviest first.

    Args:
        pairwise: Whether missed and detected components differ in kind (see above).
        n: State size.
        candidates: (weight (C,), mean (C, N), source (C,), group (C,), label (C,)); group is the measurement's index
            or -1 for a missed component, source the row of the covariance.
        members: Rows of the candidates to reduce. Shape (k,).
        missed_cov: Covariances of missed components. Shape (J, N, N).
        detected_cov: Covariances after a detection. Shape (J, n, n).
        prune: Least weight.
        merge: Largest squared distance.
        cap: Most components written.
        out: (weight, mean, covariance, detected, label) arrays to write to.
        start: First row to write.

    Returns:
        The number of components written.
    """
    weight, mean, source, group, label = candidates
    out_weight, out_mean, out_cov, out_detected, out_label = out
    N = mean.shape[1]
    heavy = members[weight[members] > prune]
    order = heavy[np.argsort(-weight[heavy], kind="mergesort")][: CANDIDATES_PER_COMPONENT * cap]
    k = order.shape[0]
    following = np.full(k, -1, np.int32)
    taken = np.zeros(k, np.bool_)
    heads = np.empty(k, np.int32)
    totals = np.empty(k)
    difference = np.empty(N)
    root = np.empty((N, N + 1))
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
                other = order[i]
                if taken[i] or (pairwise and group[other] != group[head]):
                    continue
                cov = missed_cov[source[other]] if group[other] < 0 else detected_cov[source[other]]
                difference[0] = mean[other, 0] - mean[head, 0]
                if difference[0] * difference[0] > merge * cov[0, 0]:
                    continue
                for r in range(1, size):
                    difference[r] = mean[other, r] - mean[head, r]
                if _squared_distance(difference, cov, size, merge, root) <= merge:
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
            # A Dirac's y is its measurement; a hidden Markov model's y is forgotten.
            average[r] = mean[head, r] if pairwise and r >= size else 0.0
            for c in range(N):
                cov[r, c] = 0.0
        i = h
        while i >= 0:
            member = order[i]
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
