"""Compiled bookkeeping of trajectories beside Bernoulli tracks: smoothed existence, and what ended tracks leave behind.

A track's Bernoulli says whether its target is alive now. Its trajectory may also have ended: then its present
existence says nothing about the past. `ended` holds, for each of the last L + 1 scans, the probability that the target
existed then and has disappeared since. With beta the probability of being alive (Garcia-Fernandez et al. 2020,
section III):

    predict     (1 - p_S) of the alive mass ends; each past scan at which it had begun gets its share
    update      ended mass is multiplied by P(no detection) / (1 - r p_D), the factor of an absent target
    existence   P(exists at k - l | Z_1:k) = r_k P(begun by k - l) + ended_l
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.sets import HELD
from servotrack.estimators.types import Array, Labels


class Trajectories(NamedTuple):
    """Trajectories of several runs: those of the tracks in the rows of the tracks, then those that have ended.

    Attributes:
        number: Number of rows in use. Shape (*batch,).
        label: Identity. Shape (*batch, M).
        alive: Probability that the target exists now. Shape (*batch, M).
        ended: Probability that it existed l scans ago and has disappeared since. Shape (*batch, M, L + 1).
        begun: Probability that it existed l scans ago, if it exists now. Shape (*batch, M, L + 1).
        length: Number of scans reported so far, those with a smoothed existence above the threshold. Shape (*batch, M).
        mean: Smoothed states when the track last existed more probably than not. Shape (*batch, M, L + 1, n).
        covariance: Covariances of these states. Shape (*batch, M, L + 1, n, n).
        hidden: Expected number of targets l scans ago that were never detected. Shape (*batch, L + 1).
        hidden_ended: Part of `hidden` that has disappeared since. Shape (*batch, L + 1).
    """

    number: Labels
    label: Labels
    alive: Array
    ended: Array
    begun: Array
    length: Labels
    mean: Array
    covariance: Array
    hidden: Array
    hidden_ended: Array


def empty_trajectories(batch: int, capacity: int, lag: int, n: int) -> Trajectories:
    """Tables without trajectories, all entries zero."""
    shape = (batch, capacity)
    past = (*shape, lag + 1)
    return Trajectories(
        np.zeros(batch, np.int64),
        np.zeros(shape, np.int64),
        np.zeros(shape),
        np.zeros(past),
        np.zeros(past),
        np.zeros(shape, np.int64),
        np.zeros((*past, n)),
        np.zeros((*past, n, n)),
        np.zeros((batch, lag + 1)),
        np.zeros((batch, lag + 1)),
    )


@njit(cache=True, nogil=True)
def advance_trajectories(  # type: ignore[no-untyped-def]
    state, survival, hidden_survival, absent, threshold, shift, out
):
    """Write the trajectories after a step.

    Args:
        state: State before the step: `tracks`, `pool`, `undetected`, `past`, `hidden_past` and `trajectories` are read.
        survival: p_S of the components of the tracks. Shape (B, K).
        hidden_survival: p_S of the components of undetected targets. Shape (B, H).
        absent: Factor of the update for absent targets, as in `Lineage`. Shape (B, T).
        threshold: Existence above which a trajectory is reported.
        shift: 1 for a new instant; 0 for another scan of the last one.
        out: State after the step; its `trajectories` are zero on entry and written.
    """
    tracks, pool, old, new = state.tracks, state.pool, state.trajectories, out.trajectories
    n = new.mean.shape[3]
    lag = new.ended.shape[2] - 1
    for b in range(tracks.number.shape[0]):
        rows = old.number[b]
        ended = np.zeros((rows, lag + 1))
        ended[:, shift:] = old.ended[b, :rows, : lag + 1 - shift]
        c = 0
        for i in range(tracks.number[b]):
            # Tracks have the first rows of the table.
            for _ in range(tracks.size[b, i]):
                gone = tracks.existence[b, i] * pool.weight[b, c] * (1.0 - survival[b, c])
                for past in range(lag):
                    ended[i, past + 1] += gone * (1.0 if past == 0 else state.past.begun[b, c, past - 1])
                c += 1
            for past in range(lag + 1):
                ended[i, past] = min(ended[i, past] * absent[b, i], 1.0)
        order = np.argsort(old.label[b, :rows], kind="mergesort")
        ordered = old.label[b, :rows][order]
        taken = np.zeros(rows, np.bool_)
        c = 0
        for i in range(out.tracks.number[b]):
            label, size = out.tracks.label[b, i], out.tracks.size[b, i]
            new.label[b, i], new.alive[b, i] = label, out.tracks.existence[b, i]
            at = np.searchsorted(ordered, label)
            source = order[at] if at < rows and ordered[at] == label else -1
            if source >= 0:
                taken[source] = True
                new.ended[b, i], new.length[b, i] = ended[source], old.length[b, source]
                # These states stay where the target has probably disappeared: the track then holds little of its past.
                _shift(old, b, source, new, i, shift)
            for past in range(lag + 1):
                best, heaviest = c, -1.0
                for k in range(c, c + size):
                    share = out.pool.weight[b, k] * (1.0 if past == 0 else out.past.begun[b, k, past - 1])
                    new.begun[b, i, past] = 1.0 if past == 0 else new.begun[b, i, past] + share
                    if share > heaviest:
                        best, heaviest = k, share
                if past == 0:
                    new.mean[b, i, 0] = out.pool.mean[b, best, :n]
                    new.covariance[b, i, 0] = out.pool.covariance[b, best, :n, :n]
                elif heaviest > 0.0 and (source < 0 or new.alive[b, i] > threshold):
                    new.mean[b, i, past] = out.past.mean[b, best, past - 1]
                    new.covariance[b, i, past] = out.past.covariance[b, best, past - 1]
            c += size
        row = out.tracks.number[b]
        for source in range(rows):
            if taken[source] or row == new.label.shape[1] or ended[source].max() < HELD:
                continue
            new.label[b, row], new.ended[b, row] = old.label[b, source], ended[source]
            new.length[b, row] = old.length[b, source]
            _shift(old, b, source, new, row, shift)
            row += 1
        new.number[b] = row
        for i in range(row):
            if new.alive[b, i] * new.begun[b, i, lag] + new.ended[b, i, lag] > threshold:
                new.length[b, i] += shift
        new.hidden_ended[b, shift:] = old.hidden_ended[b, : lag + 1 - shift]
        hidden = state.undetected
        for k in range(hidden.number[b]):
            gone = hidden.weight[b, k] * (1.0 - hidden_survival[b, k])
            for past in range(lag):
                new.hidden_ended[b, past + 1] += gone * (1.0 if past == 0 else state.hidden_past.begun[b, k, past - 1])
        new.hidden[b] = new.hidden_ended[b]
        hidden = out.undetected
        for k in range(hidden.number[b]):
            for past in range(lag + 1):
                share = 1.0 if past == 0 else out.hidden_past.begun[b, k, past - 1]
                new.hidden[b, past] += hidden.weight[b, k] * share


@njit(cache=True, nogil=True)
def _shift(old, b, source, new, row, shift):  # type: ignore[no-untyped-def]
    """Copy the smoothed states of a trajectory to those of `shift` scans earlier."""
    for past in range(new.mean.shape[2] - shift):
        new.mean[b, row, past + shift] = old.mean[b, source, past]
        new.covariance[b, row, past + shift] = old.covariance[b, source, past]


@njit(cache=True, nogil=True)
def smoothed_tracks(trajectories, past, threshold, least_length, tracks, mixture):  # type: ignore[no-untyped-def]
    """Write the trajectories' existence and states at an earlier scan as tracks of one component, for the extraction.

    Args:
        trajectories: A `Trajectories`.
        past: Scans before the newest one, at most L.
        threshold: Existence above which a trajectory is reported.
        least_length: Trajectories of fewer scans that have ended get an existence of at most the threshold.
        tracks: Output: `Tracks`.
        mixture: Output: `Mixture`.

    Returns:
        Expected number of targets at that scan, withheld and undetected ones included. Shape (B,).
    """
    n = trajectories.mean.shape[3]
    window = trajectories.ended.shape[2] - 1
    expected = trajectories.hidden[:, past].copy()
    for b in range(expected.shape[0]):
        for i in range(trajectories.number[b]):
            alive = trajectories.alive[b, i]
            existence = alive * trajectories.begun[b, i, past] + trajectories.ended[b, i, past]
            expected[b] += existence
            length = trajectories.length[b, i]
            for k in range(window):
                length += alive * trajectories.begun[b, i, k] + trajectories.ended[b, i, k] > threshold
            if length < least_length and alive <= threshold:
                existence = min(existence, threshold)
            tracks.existence[b, i] = min(existence, 1.0)
            tracks.label[b, i] = trajectories.label[b, i]
            tracks.size[b, i] = 1
            mixture.weight[b, i] = 1.0
            mixture.mean[b, i, :n] = trajectories.mean[b, i, past]
            mixture.covariance[b, i, :n, :n] = trajectories.covariance[b, i, past]
        tracks.number[b] = trajectories.number[b]
        mixture.number[b] = trajectories.number[b]
    return expected
