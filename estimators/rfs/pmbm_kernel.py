"""Compiled recursion of the Poisson multi-Bernoulli mixture filter (Garcia-Fernandez et al. 2018)."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.bernoulli import normalize, owners_and_detection, rows_by_key
from servotrack.estimators.rfs.gaussians import SMALLEST_LIKELIHOOD, detected_mean, weigh_pairs
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
def _identities(measurement, likelihood, label, measurements):  # type: ignore[no-untyped-def]
    """Identity of the undetected component that most probably caused each measurement, 0 if it has none (Z,)."""
    heaviest, found = np.zeros(measurements), np.zeros(measurements, np.int64)
    for p in range(measurement.shape[0]):
        if likelihood[p] > heaviest[measurement[p]]:
            heaviest[measurement[p]], found[measurement[p]] = likelihood[p], label[p]
    return found


@njit(cache=True, nogil=True)
def update_pmbm(model, prediction, state, scan, gate, limits, ranking, out, unexplained):  # type: ignore[no-untyped-def]
    """Posterior of every run: global hypotheses, their Bernoullis, and undetected targets.

    Args:
        model: The packed model.
        prediction: A `Prediction` of the Bernoullis and the undetected intensity.
        state: The `PMBMState` before the update, of which the hypotheses are read.
        scan: A `Scan`.
        gate: Largest squared Mahalanobis distance of a pair.
        limits: A `Limits`.
        ranking: A `Ranking`.
        out: A `PMBMState` to write to.
        unexplained: Output: probability of each measurement to be clutter. Shape (B, Z).

    Returns:
        True if the covariance of every predicted measurement is positive definite.
    """
    m, n = model.observation.shape
    tracks, pool, hidden, detection, hidden_detection = prediction
    z, number, clutter = scan
    cap = limits.components
    innovation = np.empty(m)
    positive_definite = True
    for b in range(tracks.existence.shape[0]):
        T, Z, count, unseen = tracks.number[b], number[b], pool.number[b], hidden.number[b]
        component, measurement, likelihood, gain, posterior, definite = weigh_pairs(
            model, count, pool.mean[b], pool.covariance[b], z[b], Z, gate
        )
        hidden_component, hidden_measurement, hidden_likelihood, hidden_gain, hidden_posterior, hidden_definite = (
            weigh_pairs(model, unseen, hidden.mean[b], hidden.covariance[b], z[b], Z, gate)
        )
        positive_definite = positive_definite and definite and hidden_definite
        pairs, fresh_pairs = component.shape[0], hidden_component.shape[0]
        owner, _ = owners_and_detection(tracks, pool, detection, b)
        # The sum itself, not one minus the sum for p_D: it is exactly zero where p_D is one.
        unlikely = np.zeros(T)
        for c in range(count):
            unlikely[owner[c]] += pool.weight[b, c] * (1.0 - detection[b, c])
        first_seen = np.zeros(Z)
        for p in range(fresh_pairs):
            i = hidden_component[p]
            hidden_likelihood[p] *= hidden_detection[b, i] * hidden.weight[b, i]
            first_seen[hidden_measurement[p]] += hidden_likelihood[p]
        for p in range(pairs):
            likelihood[p] *= detection[b, component[p]] * pool.weight[b, component[p]]
        track, to, detected, row = track_pairs(component, measurement, likelihood, owner, T, Z)
        P = track.shape[0]
        outcomes = _outcomes(
            tracks.existence[b, :T],
            unlikely,
            track,
            to,
            detected,
            clutter[b, :Z] + first_seen,
            first_seen,
            ranking,
        )
        kept, existence, start = outcomes.kept, outcomes.existence, outcomes.start

        associations = associate(state.hypotheses, b, outcomes, ranking)
        groups = merge_equal(associations, kept)
        new, into = out.tracks, out.pool
        rows = min(new.existence.shape[1], into.weight.shape[1])
        chosen, used, cut = select(
            associations, groups, outcomes, ranking, out.hypotheses.weight.shape[1], rows
        )

        # The components of all results: missed, detected, first detected.
        part = np.empty(count + pairs + fresh_pairs)
        mean = np.empty((count + pairs + fresh_pairs, n + m))
        source = np.empty(count + pairs + fresh_pairs, np.int64)
        kind = np.empty(count + pairs + fresh_pairs, np.int64)
        key = np.empty(count + pairs + fresh_pairs, np.int64)
        for c in range(count):
            i = owner[c]
            part[c] = pool.weight[b, c] * (1.0 - detection[b, c]) / unlikely[i] if unlikely[i] > 0.0 else 0.0
            mean[c], source[c], kind[c], key[c] = pool.mean[b, c], c, -1, i + start[i]
        for p in range(pairs):
            c, k = component[p], count + p
            key[k] = owner[c] + 1 + row[p]
            part[k] = likelihood[p] / detected[row[p]] if detected[row[p]] > 0.0 else 0.0
            source[k], kind[k] = c, measurement[p]
            if used[key[k]]:
                detected_mean(model, pool.mean[b, c], gain[c], z[b, measurement[p]], innovation, mean[k])
        for p in range(fresh_pairs):
            i, j, k = hidden_component[p], hidden_measurement[p], count + pairs + p
            part[k] = hidden_likelihood[p] / first_seen[j] if first_seen[j] > 0.0 else 0.0
            source[k], kind[k], key[k] = i, j, T + P + j
            detected_mean(model, hidden.mean[b, i], hidden_gain[i], z[b, j], innovation, mean[k])
        members, first_member = rows_by_key(key, T + P + Z)
        candidates = Candidates(part, mean, source, kind, np.zeros(count + pairs + fresh_pairs, np.int64))

        room = Components(into.weight[b], into.mean[b], into.covariance[b], into.detected[b], into.label[b])
        row_of = np.full(T + P + Z, -1, np.int64)
        wanted = 0
        for k in range(T + P + Z):
            wanted += used[k]
        shortfall = np.zeros(wanted)
        filled, place = 0, 0
        for k in range(T + P + Z):
            if not used[k]:
                continue
            own = members[first_member[k] : first_member[k + 1]]
            wanted -= 1
            # Every later Bernoulli finds room for one component at least.
            most = min(cap, room.weight.shape[0] - filled - wanted)
            if k < T + P:
                size = reduce_mixture(
                    model.pairwise, n, candidates, own, pool.covariance[b], posterior, limits, most, room, filled
                )
            else:
                size = reduce_mixture(
                    model.pairwise,
                    n,
                    candidates,
                    own,
                    hidden.covariance[b],
                    hidden_posterior,
                    limits,
                    most,
                    room,
                    filled,
                )
            if size == 0:
                continue
            for c in own:
                if part[c] > limits.prune:
                    shortfall[place] += part[c]
            shortfall[place] -= room.weight[filled : filled + size].sum()
            normalize(room.weight, filled, size)
            new.existence[b, place] = existence[k]
            new.size[b, place] = size
            row_of[k] = place
            place += 1
            filled += size
        for i in range(T):
            for k in range(i + start[i], i + 1 + start[i + 1]):
                if row_of[k] >= 0:
                    new.label[b, row_of[k]] = tracks.label[b, i]
                    out.identity[b, row_of[k]] = state.identity[b, i]
        known = _identities(hidden_measurement, hidden_likelihood, hidden.label[b, hidden_component], Z)
        for j in range(Z):
            if row_of[T + P + j] >= 0:
                new.label[b, row_of[T + P + j]] = out.next_label[b] + j
                out.identity[b, row_of[T + P + j]] = known[j] if known[j] > 0 else out.next_label[b] + j
        new.number[b] = place
        into.number[b] = filled
        out.next_label[b] += Z
        probability, shortened = _write_hypotheses(
            associations, groups, chosen, outcomes, used, row_of, b, out
        )
        cut += shortened
        for i in range(place):
            cut += out.share[b, i] * new.existence[b, i] * max(shortfall[i], 0.0)
        out.cut[b] = min(cut, 1.0)

        # The undetected intensity: missed again, and Bernoullis that are recycled.
        explained = np.zeros(Z)
        for p in range(P):
            explained[to[p]] += probability[track[p] + 1 + p]
        returned = np.zeros(T + P + Z)
        for k in range(T + P + Z):
            if not kept[k] and existence[k] >= ranking.existence:
                chance = probability[k] if k < T + P else max(1.0 - explained[k - T - P], 0.0)
                returned[k] = chance * existence[k]
        for j in range(Z):
            unexplained[b, j] = max(1.0 - explained[j], 0.0) * (1.0 - existence[T + P + j])
        total = unseen
        for k in range(count + pairs + fresh_pairs):
            total += returned[key[k]] > 0.0
        rest_weight = np.empty(total)
        rest_mean = np.empty((total, n + m))
        rest_source = np.empty(total, np.int64)
        rest_kind = np.empty(total, np.int64)
        rest_label = np.zeros(total, np.int64)
        covariance = np.empty((total, n + m, n + m))
        for i in range(unseen):
            rest_weight[i] = hidden.weight[b, i] * (1.0 - hidden_detection[b, i])
            rest_mean[i], covariance[i] = hidden.mean[b, i], hidden.covariance[b, i]
            rest_source[i], rest_kind[i], rest_label[i] = i, -1, hidden.label[b, i]
        c = unseen
        for k in range(count + pairs + fresh_pairs):
            if returned[key[k]] > 0.0:
                rest_weight[c], rest_mean[c] = returned[key[k]] * part[k], mean[k]
                if kind[k] < 0:
                    covariance[c], rest_source[c] = pool.covariance[b, source[k]], c
                    rest_label[c] = state.identity[b, owner[source[k]]]
                else:
                    rest_source[c], rest_label[c] = source[k], known[kind[k]]
                rest_kind[c] = kind[k]
                c += 1
        rest = out.undetected
        space = Components(rest.weight[b], rest.mean[b], rest.covariance[b], rest.detected[b], rest.label[b])
        rest.number[b] = reduce_mixture(
            model.pairwise,
            n,
            Candidates(rest_weight, rest_mean, rest_source, rest_kind, rest_label),
            np.arange(total),
            covariance,
            hidden_posterior,
            limits,
            rest.weight.shape[1],
            space,
            0,
        )
        before = rest_weight[rest_weight > limits.prune].sum()
        out.cut_undetected[b] = max(before - space.weight[: rest.number[b]].sum(), 0.0)
    return positive_definite


@njit(cache=True, nogil=True)
def project(n, state, heaviest, most, limits, out_tracks, out_pool, out_first):  # type: ignore[no-untyped-def]
    """Write one Bernoulli per track: that of the heaviest global hypothesis, or the moment projection of all.

    The projection gives a track the existence sum w r over the global hypotheses and the mixture of its Bernoullis
    (Williams 2015, section IV).

    Args:
        n: Size of the state.
        state: A `PMBMState`.
        heaviest: True for the Bernoullis of the heaviest global hypothesis; tracks that it lacks are projected.
        most: Largest existence of the tracks that it lacks.
        limits: A `Limits`.
        out_tracks: Output: a `Tracks`; its labels are the reported identities.
        out_pool: Output: a `Mixture` whose y parts are dropped.
        out_first: Output: first Bernoulli of each track. Shape (B, T).
    """
    tracks, pool, hypotheses = state.tracks, state.pool, state.hypotheses
    for b in range(tracks.existence.shape[0]):
        T, count = tracks.number[b], pool.number[b]
        best = np.zeros(T, np.bool_)
        if heaviest:
            best[hypotheses.member[b, 0, : hypotheses.size[b, 0]]] = True
        candidates = Candidates(
            np.empty(count), pool.mean[b], np.arange(count), np.full(count, -1, np.int64), np.zeros(count, np.int64)
        )
        room = Components(
            out_pool.weight[b], out_pool.mean[b], out_pool.covariance[b], out_pool.detected[b], out_pool.label[b]
        )
        place, filled, i, c = 0, 0, 0, 0
        while i < T:
            label, first, begin, existence = tracks.label[b, i], i, c, 0.0
            end = first
            while end < T and tracks.label[b, end] == label:
                end += 1
            chosen = best[first:end].any()
            while i < end:
                share = (1.0 if best[i] else 0.0) if chosen else state.share[b, i]
                presence = share * tracks.existence[b, i]
                existence += presence
                for _ in range(tracks.size[b, i]):
                    candidates.weight[c] = presence * pool.weight[b, c]
                    c += 1
                i += 1
            if existence <= 0.0:
                continue
            candidates.weight[begin:c] /= existence
            size = reduce_mixture(
                False,
                n,
                candidates,
                np.arange(begin, c),
                pool.covariance[b],
                pool.covariance[b],
                limits,
                min(limits.components, room.weight.shape[0] - filled),
                room,
                filled,
            )
            normalize(room.weight, filled, size)
            out_tracks.existence[b, place] = min(existence, most if heaviest and not chosen else 1.0)
            out_tracks.label[b, place] = state.identity[b, first]
            out_first[b, place] = first
            out_tracks.size[b, place] = size
            place += 1
            filled += size
        out_tracks.number[b] = place
        out_pool.number[b] = filled


@njit(cache=True, nogil=True)
def keep_identities(projected, first, state):  # type: ignore[no-untyped-def]
    """Write identities that changed in the extraction back to all Bernoullis of the track.

    Args:
        projected: The `Tracks` that `project` wrote, after the extraction.
        first: First Bernoulli of each of these tracks. Shape (B, T).
        state: A `PMBMState` to write to.
    """
    labels = state.tracks.label
    for b in range(first.shape[0]):
        for t in range(projected.number[b]):
            i = first[b, t]
            track = labels[b, i]
            while i < state.tracks.number[b] and labels[b, i] == track:
                state.identity[b, i] = projected.label[b, t]
                i += 1
