"""Tables of Bernoulli tracks: each has a probability of existence and a Gaussian mixture in a shared pool."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.mixture import append_births, append_spawn, predict_components
from servotrack.estimators.types import Array, Labels


class Tracks(NamedTuple):
    """Bernoulli tracks of several runs; the first `number` rows of a run are in use.

    The components of a track are consecutive rows of the pool, in order of the tracks, and their weights sum to one.

    Attributes:
        number: Number of tracks. Shape (*batch,).
        existence: Probability of existence. Shape (*batch, T).
        label: Identity, 0 for none yet. Shape (*batch, T).
        size: Number of components. Shape (*batch, T).
    """

    number: Labels
    existence: Array
    label: Labels
    size: Labels


def empty_tracks(batch: int, capacity: int) -> Tracks:
    """Tables without tracks, all entries zero."""
    shape = (batch, capacity)
    return Tracks(np.zeros(batch, np.int64), np.zeros(shape), np.zeros(shape, np.int64), np.zeros(shape, np.int64))


@njit(cache=True, nogil=True)
def predict_tracks(model, tracks, pool, survival, work, b, out_tracks, out_pool):  # type: ignore[no-untyped-def]
    """Predict the tracks of run b: r' = r <p, p_S>, densities weighed by p_S (Vo, Vo and Cantoni 2009)."""
    predict_components(model, pool, b, work, out_pool)
    row = 0
    for i in range(tracks.number[b]):
        size = tracks.size[b, i]
        alive = 0.0
        for c in range(row, row + size):
            alive += survival[b, c] * pool.weight[b, c]
        for c in range(row, row + size):
            out_pool.weight[b, c] = survival[b, c] * pool.weight[b, c] / alive if alive > 0.0 else pool.weight[b, c]
        out_tracks.existence[b, i] = tracks.existence[b, i] * min(alive, 1.0)
        out_tracks.label[b, i] = tracks.label[b, i]
        out_tracks.size[b, i] = size
        row += size
    out_tracks.number[b] = tracks.number[b]
    out_pool.number[b] = row


@njit(cache=True, nogil=True)
def owners_and_detection(tracks, pool, detection, b):  # type: ignore[no-untyped-def]
    """Track index of each component of run b, and mean detection probability <p, p_D> of each track."""
    owner = np.empty(pool.number[b], np.int64)
    detectable = np.zeros(tracks.number[b])
    row = 0
    for i in range(tracks.number[b]):
        for c in range(row, row + tracks.size[b, i]):
            owner[c] = i
            detectable[i] += detection[b, c] * pool.weight[b, c]
        row += tracks.size[b, i]
        detectable[i] = min(detectable[i], 1.0)
    return owner, detectable


@njit(cache=True, nogil=True)
def rows_by_key(key, keys):  # type: ignore[no-untyped-def]
    """Group rows by key, 0 <= key < keys, in their order: the rows, and the start of each group, shape (keys + 1,)."""
    start = np.zeros(keys + 1, np.int64)
    for row in range(key.shape[0]):
        start[key[row] + 1] += 1
    for k in range(keys):
        start[k + 1] += start[k]
    rows = np.empty(key.shape[0], np.int64)
    fill = start.copy()
    for row in range(key.shape[0]):
        rows[fill[key[row]]] = row
        fill[key[row]] += 1
    return rows, start


@njit(cache=True, nogil=True)
def normalize(weight, start, count):  # type: ignore[no-untyped-def]
    """Scale `count` weights from `start` on so that they sum to one, in place."""
    total = 0.0
    for c in range(start, start + count):
        total += weight[c]
    for c in range(start, start + count):
        weight[c] /= total


@njit(cache=True, nogil=True)
def predict_with_births(  # type: ignore[no-untyped-def]
    model, tracks, pool, births, spawns, survival, out_tracks, out_pool
):
    """Predicted tracks of every run: surviving tracks, split-off tracks, and one track per birth."""
    m, n = model.observation.shape
    work = np.empty((n + m, n + m))
    for b in range(tracks.existence.shape[0]):
        predict_tracks(model, tracks, pool, survival, work, b, out_tracks, out_pool)
        row = pool.number[b]
        track = tracks.number[b]
        for term in range(spawns[0].shape[0]):
            c = 0
            for i in range(tracks.number[b]):
                out_tracks.existence[b, track] = spawns[0][term] * tracks.existence[b, i]
                out_tracks.size[b, track] = tracks.size[b, i]
                track += 1
                for _ in range(tracks.size[b, i]):
                    append_spawn(model, spawns, term, pool.mean[b, c], pool.covariance[b, c], b, row, out_pool)
                    out_pool.weight[b, row] = pool.weight[b, c]
                    c += 1
                    row += 1
        out_pool.number[b] = append_births(model, births, b, row, out_pool)
        for c in range(row, out_pool.number[b]):
            out_tracks.existence[b, track] = out_pool.weight[b, c]
            out_tracks.size[b, track] = 1
            out_pool.weight[b, c] = 1.0
            track += 1
        out_tracks.number[b] = track
