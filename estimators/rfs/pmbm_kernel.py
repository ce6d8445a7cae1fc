"""Compiled recursion of the Poisson multi-Bernoulli mixture filter (Garcia-Fernandez et al. 2018)."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.bernoulli import normalize, owners_and_detection, rows_by_key
from servotrack.estimators.rfs.gaussians import SMALLEST_LIKELIHOOD, Pairs, detected_mean, weigh_pairs
from servotrack.estimators.rfs.hypotheses import Outcomes, associate, merge_equal, select
from servotrack.estimators.rfs.pmb_kernel import track_pairs
from servotrack.estimators.rfs.reduction import Candidates, Components, reduce_mixture


@njit(cache=True, nogil=True)
def _outcomes(existence, hidden, track, to, detected, evidence, first_seen, ranking):  # type: ignore[no-untyped-def]
    """Results of an update for every Bernoulli and new track; `hidden` is <p, 1 - p_D> (Williams 2015, theorem 2)."""
    T, P, Z = existence.shape[0], track.shape[0], evidence.shape[0]
    start = np.zeros(T + 1, np.int64)
    for p in range(P):
        start[track[p] + 1] += 1
    for i in range(T):
        start[i + 1] += start[i]
    detection, missed = np.empty(P), np.empty(T)
    after, kept = np.zeros(T + P + Z), np.zeros(T + P + Z, np.bool_)
    for i in range(T):
        absent = max(1.0 - existence[i] + existence[i] * hidden[i], SMALLEST_LIKELIHOOD)
        missed[i] = math.log(absent)
        after[i + start[i]] = existence[i] * hidden[i] / absent
    for p in range(P):
        i, j = track[p], to[p]
        weight = existence[i] * detected[p]
        alternative = missed[i] + math.log(max(evidence[j], SMALLEST_LIKELIHOOD))
        detection[p] = math.log(weight) - alternative if weight > 0.0 else -np.inf
        after[i + 1 + p] = 1.0
    for j in range(Z):
        after[T + P + j] = first_seen[j] / evidence[j] if evidence[j] > 0.0 else 0.0
    for k in range(T + P + Z):
        kept[k] = after[k] > 0.0 and after[k] >= max(ranking.recycle, ranking.existence)
    return Outcomes(start, to, detection, missed, after, kept)


@njit(cache=True, nogil=True)
def _write_hypotheses(associations, groups, chosen, outcomes, used, row_of, b, out):  # type: ignore[no-untyped-def]
    """Write the global hypotheses that are kept.

    Returns:
        Probability of each result (K,); probability of the associations that are kept; probability of the hypotheses
        that lost a Bernoulli for lack of space.
    """
    kept, existence = outcomes.kept, outcomes.existence
    group, weight, first = groups
    hypotheses = out.hypotheses
    most = hypotheses.member.shape[2]
    total, shortened = 0.0, 0.0
    for g in chosen:
        total += weight[g]
    probability = np.zeros(kept.shape[0])
    stays = np.zeros(weight.shape[0], np.bool_)
    for rank in range(chosen.shape[0]):
        g = chosen[rank]
        stays[g] = True
        results = associations.result[associations.start[first[g]] : associations.start[first[g] + 1]]
        results = results[kept[results]]
        present = results[row_of[results] >= 0]
        if present.shape[0] > most or not used[results].all():
            shortened += weight[g] / total
            present = np.sort(present[np.argsort(-existence[present], kind="mergesort")[:most]])
        hypotheses.weight[b, rank] = weight[g] / total
        hypotheses.size[b, rank] = present.shape[0]
        for s in range(present.shape[0]):
            row = row_of[present[s]]
            hypotheses.member[b, rank, s] = row
            out.share[b, row] += weight[g] / total
    hypotheses.number[b] = chosen.shape[0]
    for c in range(group.shape[0]):
        if stays[group[c]]:
            for p in range(associations.start[c], associations.start[c + 1]):
                probability[associations.result[p]] += associations.weight[c] / total
    return probability, shortened


@njit(cache=True, nogil=True)
def _identities(first, label, measurements):  # type: ignore[no-untyped-def]
    """Identity of the undetected component that most probably caused each measurement, 0 if it has none (Z,)."""
    heaviest, found = np.zeros(measurements), np.zeros(measurements, np.int64)
    for p in range(first.measurement.shape[0]):
        j = first.measurement[p]
        if first.likelihood[p] > heaviest[j]:
            heaviest[j], found[j] = first.likelihood[p], label[first.component[p]]
    return found


@njit(cache=True, nogil=True)
def _parts(model, pool, detection, hidden, z, b, seen, first, shares, keys):  # type: ignore[no-untyped-def]
    """Components of all results of an update of run b: missed, detected, first detected.

    Args:
        model: The packed model.
        pool: Predicted components of the Bernoullis, a `Mixture`.
        detection: p_D of these components. Shape (B, K).
        hidden: Predicted intensity of undetected targets, a `Mixture`.
        z: Measurements. Shape (B, Z, m).
        b: The run.
        seen: `Pairs` of a component and a measurement.
        first: `Pairs` of an undetected component and a measurement.
        shares: Totals that the weights are divided by: of each missed component, each pair, each first pair.
        keys: Results that the same components belong to.

    Returns:
        A `Candidates`; the result of each component (C,).
    """
    m, n = model.observation.shape
    count, pairs, fresh = pool.number[b], seen.component.shape[0], first.component.shape[0]
    total = count + pairs + fresh
    weight, mean = np.zeros(total), np.empty((total, n + m))
    source, kind, key = np.empty(total, np.int64), np.empty(total, np.int64), np.empty(total, np.int64)
    innovation = np.empty(m)
    for c in range(count):
        if shares[0][c] > 0.0:
            weight[c] = pool.weight[b, c] * (1.0 - detection[b, c]) / shares[0][c]
        mean[c], source[c], kind[c], key[c] = pool.mean[b, c], c, -1, keys[0][c]
    for p in range(pairs):
        c, j, k = seen.component[p], seen.measurement[p], count + p
        if shares[1][p] > 0.0:
            weight[k] = seen.likelihood[p] / shares[1][p]
        source[k], kind[k], key[k] = seen.part[p], j, keys[1][p]
        detected_mean(model, pool.mean[b, c], seen.gain[seen.part[p]], z[b, j], innovation, mean[k])
    for p in range(fresh):
        c, j, k = first.component[p], first.measurement[p], count + pairs + p
        if shares[2][p] > 0.0:
            weight[k] = first.likelihood[p] / shares[2][p]
        source[k], kind[k], key[k] = first.part[p], j, keys[2][p]
        detected_mean(model, hidden.mean[b, c], first.gain[first.part[p]], z[b, j], innovation, mean[k])
    return Candidates(weight, mean, source, kind, np.zeros(total, np.int64)), key


@njit(cache=True, nogil=True)
def _write_bernoullis(model, candidates, key, used, outcomes, covariances, limits, b, out):  # type: ignore[no-untyped-def]
    """Write the Bernoullis in use.

    Args:
        model: The packed model.
        candidates: Components of all results.
        key: The result of each component. Shape (C,).
        used: Mask of the results in use. Shape (K,), bool.
        outcomes: An `Outcomes`.
        covariances: Predicted covariances and those after a detection, of old tracks and then of new ones.
        limits: A `Limits`.
        b: The run.
        out: A `PMBMState` to write to.

    Returns:
        Row of each result, -1 for none (K,); weight of components that the caps removed from each row (rows,).
    """
    n = model.observation.shape[1]
    cov, posterior, hidden_cov, hidden_posterior = covariances
    old = outcomes.missed.shape[0] + outcomes.measurement.shape[0]
    members, start = rows_by_key(key, used.shape[0])
    into = out.pool
    room = Components(into.weight[b], into.mean[b], into.covariance[b], into.detected[b], into.label[b])
    row_of = np.full(used.shape[0], -1, np.int64)
    wanted = used.sum()
    removed = np.zeros(wanted)
    filled, place = 0, 0
    for k in range(used.shape[0]):
        if not used[k]:
            continue
        own = members[start[k] : start[k + 1]]
        wanted -= 1
        # Every later Bernoulli finds room for one component at least.
        most = min(limits.components, room.weight.shape[0] - filled - wanted)
        missed, found = (cov, posterior) if k < old else (hidden_cov, hidden_posterior)
        size = reduce_mixture(model.pairwise, n, candidates, own, missed, found, limits, most, room, filled)
        if size == 0:
            continue
        for c in own:
            if candidates.weight[c] > limits.prune:
                removed[place] += candidates.weight[c]
        removed[place] = max(removed[place] - room.weight[filled : filled + size].sum(), 0.0)
        normalize(room.weight, filled, size)
        out.tracks.existence[b, place] = outcomes.existence[k]
        out.tracks.size[b, place] = size
        row_of[k] = place
        place += 1
        filled += size
    out.tracks.number[b] = place
    into.number[b] = filled
    return row_of, removed[:place]


@njit(cache=True, nogil=True)
def _write_labels(tracks, identity, known, start, row_of, b, out):  # type: ignore[no-untyped-def]
    """Write labels and identities of the Bernoullis; new tracks take that of a recycled target if `known` has one."""
    T, Z = start.shape[0] - 1, known.shape[0]
    for i in range(T):
        for k in range(i + start[i], i + 1 + start[i + 1]):
            if row_of[k] >= 0:
                out.tracks.label[b, row_of[k]] = tracks.label[b, i]
                out.identity[b, row_of[k]] = identity[b, i]
    for j in range(Z):
        row = row_of[T + start[T] + j]
        if row >= 0:
            label = out.next_label[b] + j
            out.tracks.label[b, row] = label
            out.identity[b, row] = known[j] if known[j] > 0 else label
    out.next_label[b] += Z


@njit(cache=True, nogil=True)
def _write_undetected(model, hidden, hidden_detection, recycled, covariances, limits, b, out):  # type: ignore[no-untyped-def]
    """Write the intensity of undetected targets: those missed again, and the recycled Bernoullis.

    Args:
        model: The packed model.
        hidden: Predicted intensity, a `Mixture`.
        hidden_detection: p_D of its components. Shape (B, H).
        recycled: A `Candidates`, those of weight zero included.
        covariances: Predicted covariances and those after a detection, of old tracks and then of new ones.
        limits: A `Limits`.
        b: The run.
        out: A `PMBMState` to write to.
    """
    n = model.observation.shape[1]
    cov, _, hidden_cov, hidden_posterior = covariances
    unseen = hidden.number[b]
    chosen = np.flatnonzero(recycled.weight > 0.0)
    total = unseen + chosen.shape[0]
    weight, mean = np.empty(total), np.empty((total, hidden.mean.shape[2]))
    source, kind, label = np.arange(total), np.full(total, -1, np.int64), np.empty(total, np.int64)
    covariance = np.empty((total, mean.shape[1], mean.shape[1]))
    for i in range(unseen):
        weight[i] = hidden.weight[b, i] * (1.0 - hidden_detection[b, i])
        mean[i], covariance[i], label[i] = hidden.mean[b, i], hidden_cov[i], hidden.label[b, i]
    for i in range(unseen, total):
        k = chosen[i - unseen]
        weight[i], mean[i], label[i] = recycled.weight[k], recycled.mean[k], recycled.label[k]
        if recycled.group[k] < 0:
            covariance[i] = cov[recycled.source[k]]
        else:
            source[i], kind[i] = recycled.source[k], recycled.group[k]
    rest = out.undetected
    room = Components(rest.weight[b], rest.mean[b], rest.covariance[b], rest.detected[b], rest.label[b])
    size = reduce_mixture(
        model.pairwise,
        n,
        Candidates(weight, mean, source, kind, label),
        np.arange(total),
        covariance,
        hidden_posterior,
        limits,
        rest.weight.shape[1],
        room,
        0,
    )
    rest.number[b] = size
    out.cut_undetected[b] = max(weight[weight > limits.prune].sum() - room.weight[:size].sum(), 0.0)


@njit(cache=True, nogil=True)
def update_pmbm(model, prediction, state, scan, gate, limits, ranking, out, unexplained):  # type: ignore[no-untyped-def]
    """Posterior of every run: global hypotheses, their Bernoullis, and undetected targets.

    Args:
        model: The packed model.
        prediction: A `Prediction` of the Bernoullis and the undetected intensity.
        state: The `PMBMState` before the update, of which hypotheses and identities are read.
        scan: A `Scan`.
        gate: Largest squared Mahalanobis distance of a pair.
        limits: A `Limits`.
        ranking: A `Ranking`.
        out: A `PMBMState` to write to.
        unexplained: Output: probability of each measurement to be clutter. Shape (B, Z).

    Returns:
        True if the covariance of every predicted measurement is positive definite.
    """
    tracks, pool, hidden, detection, hidden_detection = prediction
    z, number, clutter, excess = scan
    positive_definite = True
    for b in range(tracks.existence.shape[0]):
        T, Z, count = tracks.number[b], number[b], pool.number[b]
        component, measurement, likelihood, part, gain, posterior, definite = weigh_pairs(
            model, count, pool.mean[b], pool.covariance[b], z[b], excess[b], Z, gate
        )
        seen = Pairs(component, measurement, likelihood, part, gain)
        component, measurement, likelihood, part, gain, hidden_posterior, hidden_definite = weigh_pairs(
            model, hidden.number[b], hidden.mean[b], hidden.covariance[b], z[b], excess[b], Z, gate
        )
        first = Pairs(component, measurement, likelihood, part, gain)
        positive_definite = positive_definite and definite and hidden_definite
        owner, _ = owners_and_detection(tracks, pool, detection, b)
        # The sum itself, not one minus the sum for p_D: it is exactly zero where p_D is one.
        unlikely, first_seen = np.zeros(T), np.zeros(Z)
        for c in range(count):
            unlikely[owner[c]] += pool.weight[b, c] * (1.0 - detection[b, c])
        first.likelihood[:] *= hidden_detection[b, first.component] * hidden.weight[b, first.component]
        for p in range(first.component.shape[0]):
            first_seen[first.measurement[p]] += first.likelihood[p]
        seen.likelihood[:] *= detection[b, seen.component] * pool.weight[b, seen.component]
        track, to, detected, row = track_pairs(seen.component, seen.measurement, seen.likelihood, owner, T, Z)
        P = track.shape[0]
        outcomes = _outcomes(
            tracks.existence[b, :T], unlikely, track, to, detected, clutter[b, :Z] + first_seen, first_seen, ranking
        )
        start, existence = outcomes.start, outcomes.existence

        associations = associate(state.hypotheses, b, outcomes, ranking)
        groups = merge_equal(associations, outcomes.kept)
        rows = min(out.tracks.existence.shape[1], out.pool.weight.shape[1])
        chosen, used, cut = select(associations, groups, outcomes, ranking, out.hypotheses.weight.shape[1], rows)

        shares = (unlikely[owner], detected[row], first_seen[first.measurement])
        keys = (owner + start[owner], owner[seen.component] + 1 + row, T + P + first.measurement.astype(np.int64))
        parts, key = _parts(model, pool, detection, hidden, z, b, seen, first, shares, keys)
        covariances = (pool.covariance[b], posterior, hidden.covariance[b], hidden_posterior)
        row_of, removed = _write_bernoullis(model, parts, key, used, outcomes, covariances, limits, b, out)
        known = _identities(first, hidden.label[b], Z)
        _write_labels(tracks, state.identity, known, start, row_of, b, out)
        probability, shortened = _write_hypotheses(associations, groups, chosen, outcomes, used, row_of, b, out)
        cut += shortened
        for i in range(removed.shape[0]):
            cut += out.share[b, i] * out.tracks.existence[b, i] * removed[i]
        out.cut[b] = min(cut, 1.0)

        explained = np.zeros(Z)
        for p in range(P):
            explained[to[p]] += probability[track[p] + 1 + p]
        for j in range(Z):
            probability[T + P + j] = max(1.0 - explained[j], 0.0)
            unexplained[b, j] = probability[T + P + j] * (1.0 - existence[T + P + j])
        for k in range(key.shape[0]):
            returns = not outcomes.kept[key[k]] and existence[key[k]] >= ranking.existence
            parts.weight[k] *= probability[key[k]] * existence[key[k]] if returns else 0.0
            parts.label[k] = state.identity[b, owner[parts.source[k]]] if parts.group[k] < 0 else known[parts.group[k]]
        _write_undetected(model, hidden, hidden_detection, parts, covariances, limits, b, out)
    return positive_definite
