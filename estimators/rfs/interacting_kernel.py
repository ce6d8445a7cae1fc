"""Compiled interacting multiple models (Blom and Bar-Shalom 1988) inside the components of Bernoulli tracks.

A component of S motion modes is a block of S consecutive rows of the pool, one Gaussian per mode; the weight of a row
is the weight of the component times the probability of the mode. The weight of an association is therefore the sum over
the rows of a block, as over the rows of a mixture. Blocks differ from a plain mixture in two places: the modes are
mixed before a prediction, and a block is pruned, merged and capped as a whole, its modes separately.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.gaussians import PackedModel, predict_gaussian
from servotrack.estimators.rfs.reduction import squared_distance
from servotrack.estimators.types import Array


class PackedModes(NamedTuple):
    """Arrays of S motion modes for the compiled kernels; the measurement is the same in all of them.

    Attributes:
        transition: B of each mode. Shape (S, N, N).
        noise: Sigma of each mode. Shape (S, N, N).
        switching: Probability of mode c after mode r. Shape (S, S).
        initial: Probabilities of the modes of a new track. Shape (S,).
    """

    transition: Array
    noise: Array
    switching: Array
    initial: Array


ONE_MODE = np.ones(1)
"""Initial probabilities of the modes of a filter without modes."""


@njit(cache=True, nogil=True)
def predict_modes(model, modes, tracks, pool, survival, work, b, out_tracks, out_pool):  # type: ignore[no-untyped-def]
    """Predict the tracks of run b: r' = r <p, p_S>, modes mixed, then each mode by its own model."""
    m, n = model.observation.shape
    S, N = modes.initial.shape[0], n + m
    weight, mean, cov = np.empty(S), np.empty(N), np.zeros((N, N))
    row = 0
    for i in range(tracks.number[b]):
        size = tracks.size[b, i]
        alive = 0.0
        for c in range(row, row + size):
            alive += survival[b, c] * pool.weight[b, c]
        for first in range(row, row + size, S):
            for s in range(S):
                share = pool.weight[b, first + s]
                weight[s] = survival[b, first + s] * share / alive if alive > 0.0 else share
            for to in range(S):
                own = PackedModel(
                    model.kind,
                    model.pairwise,
                    modes.transition[to],
                    modes.noise[to],
                    model.observation,
                    model.measurement_noise,
                    model.sensor,
                    model.angular,
                )
                detected = pool.detected[b, first]
                out_pool.weight[b, first + to] = _mix(
                    weight, modes.switching[:, to], pool.mean[b], pool.covariance[b], first, n, detected, mean, cov
                )
                predict_gaussian(
                    own, mean, cov, detected, work, out_pool.mean[b, first + to], out_pool.covariance[b, first + to]
                )
                out_pool.label[b, first + to] = 0
        out_tracks.existence[b, i] = tracks.existence[b, i] * min(alive, 1.0)
        out_tracks.label[b, i] = tracks.label[b, i]
        out_tracks.size[b, i] = size
        row += size
    out_tracks.number[b] = tracks.number[b]
    out_pool.number[b] = row


@njit(cache=True, nogil=True)
def _mix(weight, switching, means, covs, first, n, detected, mean, cov):  # type: ignore[no-untyped-def]
    """Mean and covariance before the prediction by one mode, from all modes of a block; returns the mode's weight."""
    S, N = weight.shape[0], means.shape[1]
    # After a detection y is the same in all modes, and exact.
    size = n if detected else N
    total = 0.0
    for s in range(S):
        total += weight[s] * switching[s]
    mean[:] = 0.0
    if size < N:
        mean[n:] = means[first, n:]
    for r in range(size):
        for c in range(r + 1):
            cov[r, c] = 0.0
    for s in range(S):
        share = weight[s] * switching[s] / total if total > 0.0 else 1.0 / S
        for r in range(size):
            mean[r] += share * means[first + s, r]
    for s in range(S):
        share = weight[s] * switching[s] / total if total > 0.0 else 1.0 / S
        if share == 0.0:
            continue
        for r in range(size):
            spread = share * (means[first + s, r] - mean[r])
            for c in range(r + 1):
                cov[r, c] += share * covs[first + s, r, c] + spread * (means[first + s, c] - mean[c])
    for r in range(size):
        for c in range(r):
            cov[c, r] = cov[r, c]
    return total


@njit(cache=True, nogil=True)
def start_modes(modes, count, out, start):  # type: ignore[no-untyped-def]
    """Give each of the `count` components written from `start` on a row per mode; return the number of rows."""
    S = modes.shape[0]
    for k in range(count - 1, -1, -1):
        weight = out.weight[start + k]
        for s in range(S - 1, -1, -1):
            row = start + k * S + s
            if row != start + k:
                out.mean[row] = out.mean[start + k]
                out.covariance[row] = out.covariance[start + k]
                out.detected[row], out.label[row] = out.detected[start + k], out.label[start + k]
            out.weight[row] = weight * modes[s]
    return count * S


@njit(cache=True, nogil=True)
def _blocks(S, candidates, component, members):  # type: ignore[no-untyped-def]
    """Candidates of each component and measurement, one per mode or -1, and their joint weight: (H, S), (H,)."""
    weight, group = candidates.weight, candidates.group
    k = members.shape[0]
    rows = np.full((k, S), -1, np.int64)
    total = np.zeros(k)
    if k == 0:
        return rows, total
    lowest = component[members[0]] // S
    highest, columns = lowest, 1
    for i in range(k):
        highest = max(highest, component[members[i]] // S)
        columns = max(columns, group[members[i]] + 2)
    slot = np.full((highest - lowest + 1, columns), -1, np.int64)
    number = 0
    for i in range(k):
        member = members[i]
        block, column = component[member] // S - lowest, group[member] + 1
        h = slot[block, column]
        if h < 0:
            h = number
            slot[block, column] = h
            number += 1
        rows[h, component[member] % S] = member
        total[h] += weight[member]
    return rows[:number], total[:number]


@njit(cache=True, nogil=True)
def reduce_modes(  # type: ignore[no-untyped-def]
    pairwise, n, S, candidates, component, members, missed_cov, detected_cov, limits, cap, out, start
):
    """Prune, merge and cap blocks of S modes; arguments as in `reduce_mixture`.

    Blocks merge by the distance of their overall means in the overall covariance of the lighter one, mode by mode.

    Args:
        pairwise: True if missed and detected components differ in kind.
        n: State size.
        S: Number of modes.
        candidates: A `Candidates`.
        component: Predicted component of each candidate; S successive ones are a block. Shape (C,).
        members: Rows of the candidates of one track, in the order of their components. Shape (k,).
        missed_cov: Covariances of missed components. Shape (J, N, N).
        detected_cov: Covariances after a detection. Shape (J, n, n).
        limits: A `Limits`.
        cap: Largest number of blocks written.
        out: A `Components` to write to.
        start: First row to write.

    Returns:
        Number of rows written, S for each block.
    """
    weight, mean, source, group, _ = candidates
    rows, total = _blocks(S, candidates, component, members)
    N = mean.shape[1]
    heavy = np.flatnonzero(total > limits.prune)
    order = heavy[np.argsort(-total[heavy], kind="mergesort")][: limits.candidates * cap]
    k = order.shape[0]
    center, spread = np.zeros((k, N)), np.zeros((k, N, N))
    missed = np.empty(k, np.bool_)
    measurement = np.empty(k, np.int64)
    for h in range(k):
        for s in range(S):
            if rows[order[h], s] >= 0:
                measurement[h] = group[rows[order[h], s]]
        missed[h] = measurement[h] < 0
        _moments(rows[order[h]], weight, mean, source, missed_cov if missed[h] else detected_cov, center[h], spread[h])
    following = np.full(k, -1, np.int64)
    taken = np.zeros(k, np.bool_)
    heads, totals = np.empty(k, np.int64), np.empty(k)
    difference, root = np.empty(N), np.empty((N, N + 1))
    number = 0
    for h in range(k):
        if taken[h]:
            continue
        size = N if pairwise and missed[h] else n
        heads[number], totals[number] = h, total[order[h]]
        last = h
        for i in range(h + 1, k):
            if limits.merge <= 0.0 or taken[i] or (pairwise and measurement[i] != measurement[h]):
                continue
            for r in range(size):
                difference[r] = center[i, r] - center[h, r]
            if squared_distance(difference, spread[i], size, limits.merge, root) <= limits.merge:
                taken[i] = True
                following[last] = i
                last = i
                totals[number] += total[order[i]]
        number += 1
    ranking = np.argsort(-totals[:number], kind="mergesort")[:cap]
    chain = np.empty(k * S, np.int64)
    for rank in range(ranking.shape[0]):
        head = heads[ranking[rank]]
        own = pairwise and missed[head]
        size = N if own else n
        for s in range(S):
            length = 0
            whole = 0
            i = head
            while i >= 0:
                if rows[order[i], s] >= 0 and weight[rows[order[i], s]] > 0.0:
                    chain[length] = rows[order[i], s]
                    length += 1
                i = following[i]
            if length == 0:
                # The mode is impossible now, and revives by mixing: any moments do.
                i = head
                while i >= 0:
                    for other in range(S):
                        if rows[order[i], other] >= 0:
                            chain[whole] = rows[order[i], other]
                            whole += 1
                    i = following[i]
            row = start + rank * S + s
            _write_mode(
                chain[: max(length, whole)], candidates, missed_cov, detected_cov, size, pairwise and not own, out, row
            )
            if length == 0:
                out.weight[row] = 0.0
            out.detected[row] = not own
    return ranking.shape[0] * S


@njit(cache=True, nogil=True)
def _moments(rows, weight, mean, source, covs, center, spread):  # type: ignore[no-untyped-def]
    """Overall mean and covariance of one block, over all entries that its covariances have."""
    size = covs.shape[1]
    total = 0.0
    for row in rows:
        if row >= 0:
            total += weight[row]
    for row in rows:
        if row >= 0:
            for r in range(mean.shape[1]):
                center[r] += weight[row] / total * mean[row, r]
    for row in rows:
        if row >= 0:
            share, part = weight[row] / total, covs[source[row]]
            for r in range(size):
                off = mean[row, r] - center[r]
                for c in range(r + 1):
                    spread[r, c] += share * (part[r, c] + off * (mean[row, c] - center[c]))
    for r in range(size):
        for c in range(r):
            spread[c, r] = spread[r, c]


@njit(cache=True, nogil=True)
def _write_mode(  # type: ignore[no-untyped-def]
    chain, candidates, missed_cov, detected_cov, size, exact, out, row
):
    """Write the moments of some candidates of one mode to a row; `exact` keeps their measurement as y."""
    weight, mean, source, group, _ = candidates
    N = mean.shape[1]
    total = 0.0
    for member in chain:
        total += weight[member]
    out.weight[row] = total
    out.label[row] = 0
    average, cov = out.mean[row], out.covariance[row]
    for r in range(N):
        average[r] = mean[chain[0], r] if exact and r >= size else 0.0
        for c in range(N):
            cov[r, c] = 0.0
    for member in chain:
        share = weight[member] / total if total > 0.0 else 1.0 / chain.shape[0]
        for r in range(size):
            average[r] += share * mean[member, r]
    for member in chain:
        share = weight[member] / total if total > 0.0 else 1.0 / chain.shape[0]
        part = missed_cov[source[member]] if group[member] < 0 else detected_cov[source[member]]
        for r in range(size):
            off = mean[member, r] - average[r]
            for c in range(r + 1):
                cov[r, c] += share * (part[r, c] + off * (mean[member, c] - average[c]))
    for r in range(size):
        for c in range(r):
            cov[c, r] = cov[r, c]


@njit(cache=True, nogil=True)
def collapse_modes(n, S, tracks, pool, out_tracks, out_pool):  # type: ignore[no-untyped-def]
    """Write each block of modes as one Gaussian over the state, for the extraction; identities are shared."""
    for b in range(tracks.number.shape[0]):
        out_tracks.number[b] = tracks.number[b]
        for i in range(tracks.number[b]):
            out_tracks.existence[b, i], out_tracks.size[b, i] = tracks.existence[b, i], tracks.size[b, i] // S
        blocks = pool.number[b] // S
        out_pool.number[b] = blocks
        for block in range(blocks):
            total = 0.0
            for s in range(S):
                total += pool.weight[b, block * S + s]
            out_pool.weight[b, block] = total
            mean, cov = out_pool.mean[b, block], out_pool.covariance[b, block]
            mean[:] = 0.0
            cov[:] = 0.0
            for s in range(S):
                share = pool.weight[b, block * S + s] / total if total > 0.0 else 1.0 / S
                for r in range(n):
                    mean[r] += share * pool.mean[b, block * S + s, r]
            for s in range(S):
                share = pool.weight[b, block * S + s] / total if total > 0.0 else 1.0 / S
                for r in range(n):
                    off = share * (pool.mean[b, block * S + s, r] - mean[r])
                    for c in range(r + 1):
                        cov[r, c] += share * pool.covariance[b, block * S + s, r, c] + off * (
                            pool.mean[b, block * S + s, c] - mean[c]
                        )
            for r in range(n):
                for c in range(r):
                    cov[c, r] = cov[r, c]
