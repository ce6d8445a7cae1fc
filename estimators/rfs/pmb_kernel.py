"""Compiled recursion of the Poisson multi-Bernoulli filter (Williams 2015)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.association import association_marginals
from servotrack.estimators.rfs.bernoulli import (
    Tracks,
    normalize,
    owners_and_detection,
    predict_tracks,
    rows_by_key,
)
from servotrack.estimators.rfs.gaussians import detected_mean, weigh_pairs
from servotrack.estimators.rfs.histories import update_histories
from servotrack.estimators.rfs.interacting_kernel import predict_modes, reduce_modes, start_modes
from servotrack.estimators.rfs.mixture import Mixture, append_births, append_spawn, predict_components
from servotrack.estimators.rfs.reduction import Candidates, Components, reduce_mixture
from servotrack.estimators.rfs.sets import Scan
from servotrack.estimators.types import Array, Labels

SMALLEST_ABSENCE = 1e-12
"""Lower limit of 1 - r p_D, which is zero for a certain target and a perfect sensor."""

SMALLEST_EVIDENCE = 1e-30
"""Lower limit of a measurement's intensity under clutter and undetected targets, which is zero without both."""


class Prediction(NamedTuple):
    """Predicted targets of all runs.

    Attributes:
        tracks: Tracks of targets detected at least once.
        pool: Components of the tracks.
        hidden: Intensity of targets never detected.
        detection: p_D of the tracks' components. Shape (B, K).
        hidden_detection: p_D of the components of `hidden`. Shape (B, H).
    """

    tracks: Tracks
    pool: Mixture
    hidden: Mixture
    detection: Array
    hidden_detection: Array


class Tally(NamedTuple):
    """Association probabilities of one scan.

    Attributes:
        unexplained: Probability of each measurement to be clutter. Shape (B, Z).
        detected: Probability of each predicted track to be detected. Shape (B, T).
        origin: Predicted track of each new track, -1 - j for one that measurement j started. Shape (B, T').
        elsewhere: Probability that the target of a measurement, if it is a new one, belongs to the components of the
            undetected targets that are marked by a label of 1. Shape (B, Z).
    """

    unexplained: Array
    detected: Array
    origin: Labels
    elsewhere: Array


def empty_tally(scan: Scan, before: Tracks, after: Tracks) -> Tally:
    """Tally of a scan, to be written by `update_pmb`, for tracks in arrays of these capacities."""
    return Tally(
        np.zeros(scan.clutter.shape),
        np.zeros(before.existence.shape),
        np.full(after.existence.shape, -1, np.int64),
        np.zeros(scan.clutter.shape),
    )


@njit(cache=True, nogil=True)
def predict_pmb(  # type: ignore[no-untyped-def]
    model, state, presence, births, spawns, survival, hidden_survival, out_tracks, out_pool, out_hidden
):
    """Predicted tracks and undetected targets of every run; births and split-off targets are undetected.

    `presence` is the probability of each track, shape (B, T), by which targets split off.
    """
    m, n = model.observation.shape
    work = np.empty((n + m, n + m))
    for b in range(state.tracks.existence.shape[0]):
        predict_tracks(model, state.tracks, state.pool, survival, work, b, out_tracks, out_pool)
        predict_undetected(model, state, presence, births, spawns, hidden_survival, b, work, out_hidden)


@njit(cache=True, nogil=True)
def predict_adaptive(  # type: ignore[no-untyped-def]
    model, modes, state, births, sites, spawns, survival, hidden_survival, out_tracks, out_pool, out_hidden
):
    """`predict_pmb` with motion modes, a `PackedModes`, in every component of the tracks.

    Births from row `sites` on are marked by a label of 1.
    """
    m, n = model.observation.shape
    work = np.empty((n + m, n + m))
    for b in range(state.tracks.existence.shape[0]):
        predict_modes(model, modes, state.tracks, state.pool, survival, work, b, out_tracks, out_pool)
        presence = state.tracks.existence
        predict_undetected(model, state, presence, births, spawns, hidden_survival, b, work, out_hidden)
        source = b if births.weight.shape[0] > 1 else 0
        row = out_hidden.number[b]
        for k in range(births.weight.shape[1] - 1, sites - 1, -1):
            if births.weight[source, k] > 0.0:
                row -= 1
                out_hidden.label[b, row] = 1


@njit(cache=True, nogil=True)
def predict_undetected(  # type: ignore[no-untyped-def]
    model, state, presence, births, spawns, survival, b, work, out
):
    """Predict the undetected targets of run b and append births and split-off targets; arguments as above."""
    tracks, pool, hidden = state.tracks, state.pool, state.undetected
    predict_components(model, hidden, b, work, out)
    row = hidden.number[b]
    for i in range(row):
        out.weight[b, i] = survival[b, i] * hidden.weight[b, i]
    for term in range(spawns[0].shape[0]):
        c = 0
        for i in range(tracks.number[b]):
            for _ in range(tracks.size[b, i]):
                append_spawn(model, spawns, term, pool.mean[b, c], pool.covariance[b, c], b, row, out)
                out.weight[b, row] = spawns[0][term] * presence[b, i] * pool.weight[b, c]
                c += 1
                row += 1
    out.number[b] = append_births(model, births, b, row, out)


@njit(cache=True, nogil=True)
def track_pairs(component, measurement, likelihood, owner, tracks, measurements):  # type: ignore[no-untyped-def]
    """Sum the likelihoods of components over tracks: track, measurement and sum, (P,) each; row of each pair."""
    pairs = component.shape[0]
    track = np.empty(pairs, np.int64)
    to = np.empty(pairs, np.int64)
    value = np.empty(pairs)
    row = np.empty(pairs, np.int64)
    last = np.full(measurements, -1, np.int64)
    number = 0
    for p in range(pairs):
        i, j = owner[component[p]], measurement[p]
        # Pairs are in order of components, and those of one track are adjacent, so its slot is still the last one.
        if last[j] < 0 or track[last[j]] != i:
            last[j] = number
            track[number], to[number], value[number] = i, j, 0.0
            number += 1
        row[p] = last[j]
        value[last[j]] += likelihood[p]
    return track[:number], to[:number], value[:number], row


@njit(cache=True, nogil=True)
def update_pmb(  # type: ignore[no-untyped-def]
    model, prediction, scan, gate, limits, modes, out, tally, lineage=None
):
    """Posterior of every run: old tracks, a new track per measurement, and undetected targets (Williams 2015).

    Args:
        model: The packed model.
        prediction: A `Prediction`.
        scan: A `Scan`.
        gate: Largest squared Mahalanobis distance of a pair.
        limits: A `Limits`.
        modes: Initial probabilities of the motion modes of a track; [1.0] for one model. Shape (S,).
        out: A `PMBState` to write to.
        tally: Output: a `Tally`.
        lineage: A `Lineage` if the histories of the components are kept, else None.

    Returns:
        True if the covariance of every predicted measurement is positive definite.
    """
    m, n = model.observation.shape
    tracks, pool, hidden, detection, hidden_detection = prediction
    z, number, clutter, excess = scan
    cap, least, S = limits.components, limits.existence, modes.shape[0]
    innovation = np.empty(m)
    positive_definite = True
    for b in range(tracks.existence.shape[0]):
        T, Z, count, unseen = tracks.number[b], number[b], pool.number[b], hidden.number[b]
        component, measurement, likelihood, part, gain, posterior, definite = weigh_pairs(
            model, count, pool.mean[b], pool.covariance[b], z[b], excess[b], Z, gate
        )
        hidden_pairs = weigh_pairs(model, unseen, hidden.mean[b], hidden.covariance[b], z[b], excess[b], Z, gate)
        hidden_component, hidden_measurement, hidden_likelihood, hidden_part = hidden_pairs[:4]
        hidden_gain, hidden_posterior, hidden_definite = hidden_pairs[4:]
        positive_definite = positive_definite and definite and hidden_definite
        pairs, fresh_pairs = component.shape[0], hidden_component.shape[0]
        owner, detectable = owners_and_detection(tracks, pool, detection, b)

        first_seen = np.zeros(Z)
        for p in range(fresh_pairs):
            i = hidden_component[p]
            hidden_likelihood[p] *= hidden_detection[b, i] * hidden.weight[b, i]
            first_seen[hidden_measurement[p]] += hidden_likelihood[p]
        for p in range(pairs):
            likelihood[p] *= detection[b, component[p]] * pool.weight[b, component[p]]
        track, to, detected, row = track_pairs(component, measurement, likelihood, owner, T, Z)
        psi = np.empty(track.shape[0])
        for p in range(track.shape[0]):
            r = tracks.existence[b, track[p]]
            evidence = max(clutter[b, to[p]] + first_seen[to[p]], SMALLEST_EVIDENCE)
            psi[p] = r * detected[p] / (max(1.0 - r * detectable[track[p]], SMALLEST_ABSENCE) * evidence)
        missed, assigned, fresh = association_marginals(track, to, psi, T, Z)

        existence = np.zeros(T + Z)
        weight = np.empty(count + pairs)
        mean = np.empty((count + pairs, n + m))
        source = np.empty(count + pairs, np.int64)
        group = np.empty(count + pairs, np.int64)
        # The predicted component of each candidate; `source` is the row of its covariance.
        origin = np.empty(count + pairs, np.int64)
        for i in range(T):
            r = tracks.existence[b, i]
            existence[i] = missed[i] * r * (1.0 - detectable[i]) / max(1.0 - r * detectable[i], SMALLEST_ABSENCE)
        for c in range(count):
            unlikely = 1.0 - detectable[owner[c]]
            share = pool.weight[b, c] * (1.0 - detection[b, c]) / unlikely if unlikely > 0.0 else 0.0
            weight[c], source[c], group[c], origin[c] = existence[owner[c]] * share, c, -1, c
            mean[c] = pool.mean[b, c]
        for p in range(track.shape[0]):
            existence[track[p]] += assigned[p]
            tally.detected[b, track[p]] += assigned[p]
        for i in range(T):
            existence[i] = min(existence[i], 1.0)
        for p in range(pairs):
            c, j = component[p], measurement[p]
            weight[count + p] = assigned[row[p]] * likelihood[p] / detected[row[p]] if detected[row[p]] > 0.0 else 0.0
            source[count + p], group[count + p], origin[count + p] = part[p], j, c
            detected_mean(model, pool.mean[b, c], gain[part[p]], z[b, j], innovation, mean[count + p])
        for c in range(count):
            weight[c] /= max(existence[owner[c]], least)
        for p in range(pairs):
            weight[count + p] /= max(existence[owner[component[p]]], least)

        fresh_mean = np.empty((fresh_pairs, n + m))
        for p in range(fresh_pairs):
            i, j = hidden_component[p], hidden_measurement[p]
            detected_mean(model, hidden.mean[b, i], hidden_gain[hidden_part[p]], z[b, j], innovation, fresh_mean[p])
        for j in range(Z):
            evidence = clutter[b, j] + first_seen[j]
            real = first_seen[j] / evidence if evidence > 0.0 else 0.0
            existence[T + j] = fresh[j] * real
            tally.unexplained[b, j] = fresh[j] * (1.0 - real)
        for p in range(fresh_pairs):
            j = hidden_measurement[p]
            hidden_likelihood[p] = hidden_likelihood[p] / first_seen[j] if first_seen[j] > 0.0 else 0.0
            if hidden.label[b, hidden_component[p]] > 0:
                tally.elsewhere[b, j] += hidden_likelihood[p]

        key = np.empty(count + pairs, np.int64)
        key[:count] = owner
        for p in range(pairs):
            key[count + p] = owner[component[p]]
        rows, start = rows_by_key(key, T)
        fresh_rows, fresh_start = rows_by_key(hidden_measurement.astype(np.int64), Z)
        candidates = Candidates(weight, mean, source, group, np.zeros(count + pairs, np.int64))
        arrivals = Candidates(
            hidden_likelihood,
            fresh_mean,
            hidden_part.astype(np.int64),
            hidden_measurement.astype(np.int64),
            np.zeros(fresh_pairs, np.int64),
        )
        row_of, fresh_row_of = np.full(count + pairs, -1), np.full(fresh_pairs, -1)
        new, into = out.tracks, out.pool
        room = Components(into.weight[b], into.mean[b], into.covariance[b], into.detected[b], into.label[b])
        filled = 0
        place = 0
        for t in np.argsort(-existence, kind="mergesort"):
            if existence[t] < least or existence[t] <= 0.0 or place == new.existence.shape[1]:
                break
            most = min(cap, (room.weight.shape[0] - filled) // S)
            if t < T:
                members = rows[start[t] : start[t + 1]]
                if S == 1:
                    size = reduce_mixture(
                        model.pairwise,
                        n,
                        candidates,
                        members,
                        pool.covariance[b],
                        posterior,
                        limits,
                        most,
                        room,
                        filled,
                        row_of,
                    )
                else:
                    size = reduce_modes(
                        model.pairwise,
                        n,
                        S,
                        candidates,
                        origin,
                        members,
                        pool.covariance[b],
                        posterior,
                        limits,
                        most,
                        room,
                        filled,
                    )
            else:
                members = fresh_rows[fresh_start[t - T] : fresh_start[t - T + 1]]
                size = reduce_mixture(
                    model.pairwise,
                    n,
                    arrivals,
                    members,
                    hidden.covariance[b],
                    hidden_posterior,
                    limits,
                    most,
                    room,
                    filled,
                    fresh_row_of,
                )
                size = start_modes(modes, size, room, filled)
            if size == 0:
                continue
            normalize(room.weight, filled, size)
            new.existence[b, place] = existence[t]
            new.label[b, place] = tracks.label[b, t] if t < T else out.next_label[b] + t - T
            new.size[b, place] = size
            tally.origin[b, place] = t if t < T else -1 - (t - T)
            place += 1
            filled += size
        new.number[b] = place
        into.number[b] = filled
        out.next_label[b] += Z
        left = hidden.weight[b, :unseen] * (1.0 - hidden_detection[b, :unseen])
        indices = np.arange(unseen)
        remaining = Candidates(left, hidden.mean[b], indices, np.full(unseen, -1, np.int64), hidden.label[b, :unseen])
        rest, left_row_of = out.undetected, np.full(unseen, -1)
        space = Components(rest.weight[b], rest.mean[b], rest.covariance[b], rest.detected[b], rest.label[b])
        rest.number[b] = reduce_mixture(
            model.pairwise,
            n,
            remaining,
            indices,
            hidden.covariance[b],
            hidden_posterior,
            limits,
            rest.weight.shape[1],
            space,
            0,
            left_row_of,
        )
        if lineage is not None:
            for i in range(T):
                lineage.absent[b, i] = missed[i] / max(1.0 - tracks.existence[b, i] * detectable[i], SMALLEST_ABSENCE)
            update_histories(model, b, lineage.pool, pool, scan, candidates, origin, row_of, filled, lineage.new_pool)
            first = hidden_component.astype(np.int64)
            update_histories(
                model, b, lineage.hidden, hidden, scan, arrivals, first, fresh_row_of, filled, lineage.new_pool
            )
            update_histories(
                model,
                b,
                lineage.hidden,
                hidden,
                scan,
                remaining,
                indices,
                left_row_of,
                rest.number[b],
                lineage.new_hidden,
            )
    return positive_definite
