"""Compiled projection of a Poisson multi-Bernoulli mixture to one Bernoulli per track, the basis of extraction."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.bernoulli import normalize
from servotrack.estimators.rfs.reduction import Candidates, Components, reduce_mixture


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
