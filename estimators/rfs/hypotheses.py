"""Global hypotheses of the Poisson multi-Bernoulli mixture: association, merging, pruning and capping.

A global hypothesis is a set of Bernoullis (single-target hypotheses), at most one of each track. Bernoullis are shared
among global hypotheses. An update turns each Bernoulli into "missed" and one "detected" per measurement in its gate;
each measurement starts a new track. `Outcomes` numbers the results in ascending order of the tracks, so that a global
hypothesis is an ascending list of numbers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.assignment import best_assignments, longer
from servotrack.estimators.types import Array, Labels, Mask


class Hypotheses(NamedTuple):
    """Global hypotheses of several runs, the heaviest first; the first `number` rows of a run are in use.

    Attributes:
        number: Number of global hypotheses, at least 1. Shape (*batch,).
        weight: Probabilities, which sum to one. Shape (*batch, G).
        size: Number of Bernoullis. Shape (*batch, G).
        member: Rows of the Bernoullis in the table of tracks, ascending. Shape (*batch, G, M).
    """

    number: Labels
    weight: Array
    size: Labels
    member: Labels


def empty_hypotheses(batch: int, capacity: int, members: int) -> Hypotheses:
    """One hypothesis without Bernoullis for each run."""
    weight = np.zeros((batch, capacity))
    weight[:, 0] = 1.0
    return Hypotheses(
        np.ones(batch, np.int64),
        weight,
        np.zeros((batch, capacity), np.int64),
        np.zeros((batch, capacity, members), np.int64),
    )


class Ranking(NamedTuple):
    """Numbers that limit the global hypotheses, for the compiled kernels.

    Attributes:
        assignments: Number of associations ranked in one update.
        least_weight: Least probability of a global hypothesis.
        recycle: Existence below which a Bernoulli becomes part of the undetected intensity.
        existence: Existence below which a Bernoulli is dropped.
    """

    assignments: int
    least_weight: float
    recycle: float
    existence: float


class Outcomes(NamedTuple):
    """Results of one update for each Bernoulli of one run: T Bernoullis, P pairs in gates, Z measurements.

    Bernoulli i missed has the number i + start[i], pair p has track[p] + 1 + p, and a new track of measurement j has
    T + P + j.

    Attributes:
        start: First pair of each Bernoulli. Shape (T + 1,).
        measurement: Measurement of each pair. Shape (P,).
        detected: Logarithm of the weight of each pair over those of "missed" and of "new or clutter". Shape (P,).
        missed: Logarithm of the weight of "missed", 1 - r p_D. Shape (T,).
        existence: Existence of each result. Shape (T + P + Z,).
        kept: Mask of the results that stay Bernoullis. Shape (T + P + Z,), bool.
    """

    start: Labels
    measurement: Labels
    detected: Array
    missed: Array
    existence: Array
    kept: Mask


class Associations(NamedTuple):
    """Global hypotheses after an update, before merging.

    Attributes:
        weight: Probabilities. Shape (C,).
        start: First entry of each in `result`. Shape (C + 1,).
        result: Numbers of results: those of all Bernoullis before the update, then new tracks that are kept.
    """

    weight: Array
    start: Labels
    result: Labels


@njit(cache=True, nogil=True)
def associate(hypotheses, b, outcomes, ranking):  # type: ignore[no-untyped-def]
    """Rank the associations of each global hypothesis of run b, their number in proportion to its weight.

    Args:
        hypotheses: A `Hypotheses`.
        b: The run.
        outcomes: An `Outcomes`.
        ranking: A `Ranking`.

    Returns:
        An `Associations` whose weights sum to one; those lighter than `least_weight` times the heaviest are left out.
    """
    start_of, measurement = outcomes.start, outcomes.measurement
    T, P = start_of.shape[0] - 1, measurement.shape[0]
    Z = outcomes.existence.shape[0] - T - P
    gap = -math.log(ranking.least_weight) if ranking.least_weight > 0.0 else np.inf
    weight, start, result = np.empty(64), np.zeros(64, np.int64), np.empty(1024, np.int64)
    column_of, used = np.full(Z, -1, np.int64), np.empty(Z, np.int64)
    taken = np.zeros(Z, np.bool_)
    count, filled, peak = 0, 0, -np.inf
    for h in range(hypotheses.number[b]):
        size = hypotheses.size[b, h]
        members = hypotheses.member[b, h, :size]
        log_weight = math.log(hypotheses.weight[b, h])
        contested = 0
        columns = 0
        for i in members:
            log_weight += outcomes.missed[i]
            contested += start_of[i + 1] > start_of[i]
            for p in range(start_of[i], start_of[i + 1]):
                j = measurement[p]
                if column_of[j] < 0:
                    column_of[j], used[columns] = columns, j
                    columns += 1
        cost = np.full((contested, columns), np.inf)
        row = 0
        for i in members:
            for p in range(start_of[i], start_of[i + 1]):
                cost[row, column_of[measurement[p]]] = -outcomes.detected[p]
            row += start_of[i + 1] > start_of[i]
        most = max(1, math.ceil(ranking.assignments * hypotheses.weight[b, h]))
        totals, choices = best_assignments(cost, most, gap, log_weight - peak + gap)
        for k in range(totals.shape[0]):
            if count + 1 == start.shape[0]:
                weight, start = longer(weight), longer(start)
            while filled + size + Z > result.shape[0]:
                result = longer(result)
            weight[count] = log_weight - totals[k]
            peak = max(peak, weight[count])
            row = 0
            for i in members:
                number = i + start_of[i]
                if start_of[i + 1] > start_of[i]:
                    if choices[k, row] >= 0:
                        j = used[choices[k, row]]
                        taken[j] = True
                        for p in range(start_of[i], start_of[i + 1]):
                            if measurement[p] == j:
                                number = i + 1 + p
                    row += 1
                result[filled] = number
                filled += 1
            for j in range(Z):
                if not taken[j] and outcomes.kept[T + P + j]:
                    result[filled] = T + P + j
                    filled += 1
                taken[j] = False
            count += 1
            start[count] = filled
        for column in range(columns):
            column_of[used[column]] = -1
    weight = np.exp(weight[:count] - peak)
    return Associations(weight / weight.sum(), start[: count + 1], result[:filled])


@njit(cache=True, nogil=True)
def _equal(a, b, associations, kept):  # type: ignore[no-untyped-def]
    """Return True if two associations keep the same results."""
    start, result = associations.start, associations.result
    p, q = start[a], start[b]
    while True:
        while p < start[a + 1] and not kept[result[p]]:
            p += 1
        while q < start[b + 1] and not kept[result[q]]:
            q += 1
        if p == start[a + 1] or q == start[b + 1]:
            return p == start[a + 1] and q == start[b + 1]
        if result[p] != result[q]:
            return False
        p += 1
        q += 1


@njit(cache=True, nogil=True)
def merge_equal(associations, kept):  # type: ignore[no-untyped-def]
    """Group the associations that keep the same Bernoullis.

    Args:
        associations: An `Associations`.
        kept: Mask of the results that stay Bernoullis. Shape (K,), bool.

    Returns:
        Group of each association (C,); weight of each group (groups,); an association of each group (groups,).
    """
    count = associations.weight.shape[0]
    # Equal sets have equal sums; different sets with the same sum are told apart below.
    signature = np.zeros(count)
    for c in range(count):
        for p in range(associations.start[c], associations.start[c + 1]):
            if kept[associations.result[p]]:
                scattered = 43758.5453 * math.sin(12.9898 * (associations.result[p] + 1.0))
                signature[c] += scattered - math.floor(scattered)
    group, weight = np.empty(count, np.int64), np.zeros(count)
    first = np.empty(count, np.int64)
    groups, same_from = 0, 0
    order = np.argsort(signature, kind="mergesort")
    for rank in range(count):
        c = order[rank]
        if rank > 0 and signature[c] != signature[order[rank - 1]]:
            same_from = groups
        found = groups
        for g in range(same_from, groups):
            if _equal(first[g], c, associations, kept):
                found = g
                break
        if found == groups:
            first[groups] = c
            groups += 1
        group[c] = found
        weight[found] += associations.weight[c]
    return group, weight[:groups], first[:groups]


@njit(cache=True, nogil=True)
def select(associations, groups, outcomes, ranking, capacity, rows):  # type: ignore[no-untyped-def]
    """Choose the global hypotheses that are kept: prune the light ones, then keep the heaviest that fit.

    Args:
        associations: An `Associations`.
        groups: Result of `merge_equal`.
        outcomes: An `Outcomes`.
        ranking: A `Ranking`.
        capacity: Largest number of global hypotheses.
        rows: Largest number of Bernoullis.

    Returns:
        Groups that are kept, the heaviest first; mask of the results in use (K,); probability that the caps cut.
    """
    _, weight, first = groups
    start, result, kept = associations.start, associations.result, outcomes.kept
    used = np.zeros(kept.shape[0], np.bool_)
    heaviest = np.empty(weight.shape[0], np.int64)
    chosen, filled, cut = 0, 0, 0.0
    for g in np.argsort(-weight, kind="mergesort"):
        if (weight[g] < ranking.least_weight or weight[g] <= 0.0) and chosen > 0:
            break
        fresh = 0
        for p in range(start[first[g]], start[first[g] + 1]):
            fresh += kept[result[p]] and not used[result[p]]
        if chosen == capacity or (filled + fresh > rows and chosen > 0):
            cut += weight[g]
            # Later ones are lighter: they must not take the place of this one.
            capacity = chosen
            continue
        if filled + fresh > rows:
            cut += 1.0
        for p in range(start[first[g]], start[first[g] + 1]):
            if kept[result[p]] and not used[result[p]] and filled < rows:
                used[result[p]] = True
                filled += 1
        heaviest[chosen] = g
        chosen += 1
    return heaviest[:chosen], used, cut
