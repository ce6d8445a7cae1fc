"""Past states of Gaussian components over a fixed lag: smoothed moments that follow prediction, update and merging.

A component's history holds, for each of the last L scans, the marginal of the state of that scan and its covariance
with the newest pair (x, y). These are the blocks of the fixed-lag stack of Garcia-Fernandez et al. (2020, section IV)
that prediction, update and moment-preserving merging need, so that the cost grows with L instead of L^2; for one
component the marginals equal those of a Rauch-Tung-Striebel smoother with lag L.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.gaussians import LINEAR, add_noise, attach_measurement, cholesky_inverse, innovate
from servotrack.estimators.types import Array


class History(NamedTuple):
    """Past states of the components of a `Mixture`, in its rows; column l - 1 is l scans ago.

    Attributes:
        begun: Probability that the trajectory had begun by then. Shape (*batch, K, L).
        mean: Means of the past states. Shape (*batch, K, L, n).
        covariance: Covariances of the past states. Shape (*batch, K, L, n, n).
        cross: Covariances of the past states with the newest pair (x, y); 0 for a y that is known exactly or dropped.
            Shape (*batch, K, L, n, N).
    """

    begun: Array
    mean: Array
    covariance: Array
    cross: Array


class Lineage(NamedTuple):
    """Histories on both sides of an update of a Poisson multi-Bernoulli filter.

    Attributes:
        pool: Histories of the predicted components of the tracks.
        hidden: Histories of the predicted components of undetected targets.
        new_pool: Output: histories of the components of the tracks after the update, zero before it.
        new_hidden: Output: histories of the components of undetected targets, zero before it.
        absent: Output: factor by which the update changes the probability that a track's target is absent, be it that
            it never existed or that it has disappeared. Shape (B, T).
    """

    pool: History
    hidden: History
    new_pool: History
    new_hidden: History
    absent: Array


def empty_history(batch: int, capacity: int, lag: int, n: int, N: int) -> History:
    """Histories of components that begin now, all entries zero."""
    shape = (batch, capacity, lag)
    return History(np.zeros(shape), np.zeros((*shape, n)), np.zeros((*shape, n, n)), np.zeros((*shape, n, N)))


@njit(cache=True, nogil=True)
def predict_histories(model, mixture, history, predicted, shift, first, out):  # type: ignore[no-untyped-def]
    """Append the present states to the histories, drop the oldest ones, and predict the covariances with (x, y).

    Args:
        model: The packed model of the prediction.
        mixture: The `Mixture` before the prediction.
        history: `History` of the mixture.
        predicted: The `Mixture` after the prediction.
        shift: 1 to append the present; 0 for another scan of the same instant.
        first: Row of `predicted` and `out` that the first row of `mixture` has become. Shape (B,).
        out: Output: `History` of the predicted components, zero on entry; components that begin now have no past.
    """
    m, n = model.observation.shape
    lag = history.begun.shape[2]
    B = model.transition
    rows = n + m if model.kind == LINEAR else n
    for b in range(mixture.number.shape[0]):
        for i in range(mixture.number[b]):
            known = mixture.detected[b, i] or not model.pairwise
            columns = n if known else n + m
            row = first[b] + i
            regression = np.zeros((n, m))
            if model.kind != LINEAR:
                # Given x the past does not influence y: cov(past, y) = cov(past, x) P_xx^-1 P_xy.
                cov = predicted.covariance[b, row]
                regression = np.linalg.solve(cov[:n, :n].copy(), cov[:n, n:].copy())
            for past in range(lag):
                if past < shift:
                    begun, mean, cov = 1.0, mixture.mean[b, i, :n], mixture.covariance[b, i, :n, :n]
                    cross = mixture.covariance[b, i, :n]
                else:
                    begun, mean, cov = (
                        history.begun[b, i, past - shift],
                        history.mean[b, i, past - shift],
                        history.covariance[b, i, past - shift],
                    )
                    cross = history.cross[b, i, past - shift]
                if begun <= 0.0:
                    continue
                out.begun[b, row, past] = begun
                out.mean[b, row, past] = mean
                out.covariance[b, row, past] = cov
                target = out.cross[b, row, past]
                for c in range(rows):
                    for k in range(columns):
                        if B[c, k] != 0.0:
                            for r in range(n):
                                target[r, c] += cross[r, k] * B[c, k]
                if model.kind != LINEAR:
                    for r in range(n):
                        for c in range(m):
                            for k in range(n):
                                target[r, n + c] += target[r, k] * regression[k, c]


@njit(cache=True, nogil=True)
def update_histories(model, b, history, mixture, scan, candidates, component, row, size, out):  # type: ignore[no-untyped-def]
    """Histories of run b after an update and a reduction: hypotheses that were merged have their moments merged.

    Args:
        model: The packed model of the update.
        b: Index of the run.
        history: `History` of the predicted components.
        mixture: `Mixture` of the predicted components.
        scan: A `Scan`.
        candidates: `Candidates` of the reduction.
        component: Predicted component of each candidate. Shape (C,).
        row: Row that each candidate was merged into, -1 for a dropped one. Shape (C,).
        size: Number of rows.
        out: Output: `History` of the rows, zero on entry. Rows without a candidate are unchanged.
    """
    m, n = model.observation.shape
    weight, hypothesis_mean, source, group, _ = candidates
    mean, cov = mixture.mean[b], mixture.covariance[b]
    before, past_mean, past_cov, past_cross = history.begun[b], history.mean[b], history.covariance[b], history.cross[b]
    out_begun, out_mean, out_cov, out_cross = out.begun[b], out.mean[b], out.covariance[b], out.cross[b]
    count, lag = before.shape
    z, excess = scan.measurements, scan.excess
    # Candidates with the same covariance after a detection share what follows from it.
    kinds = count
    for h in range(weight.shape[0]):
        kinds = max(kinds, source[h] + 1)
    found = np.zeros(kinds, np.bool_)
    gain = np.empty((kinds, lag, n, m))
    later_cov = np.empty((kinds, lag, n, n))
    later_cross = np.empty((kinds, lag, n, n))
    noisy = np.empty((n + m, n + m))
    root, half, innovation = np.empty((m, m)), np.empty((n, m)), np.empty(m)
    total = np.zeros(size)
    newest = np.zeros((size, n + m))
    candidates = weight.shape[0]
    for h in range(candidates):
        if row[h] < 0:
            continue
        total[row[h]] += weight[h]
        i, kind = component[h], source[h]
        if group[h] >= 0 and not found[kind]:
            found[kind] = True
            if excess.shape[1] > 0:
                add_noise(model, cov[i], excess[b, group[h]], noisy)
                cholesky_inverse(noisy, m, n, root)
            else:
                cholesky_inverse(cov[i], m, n, root)
            for past in range(lag):
                if before[i, past] <= 0.0:
                    break
                cross = past_cross[i, past]
                for r in range(n):
                    for c in range(m):
                        value = 0.0
                        for k in range(c + 1):
                            value += cross[r, n + k] * root[c, k]
                        half[r, c] = value
                    for c in range(m):
                        value = 0.0
                        for k in range(c, m):
                            value += half[r, k] * root[k, c]
                        gain[kind, past, r, c] = value
                for r in range(n):
                    for c in range(n):
                        value, other = past_cov[i, past, r, c], cross[r, c]
                        for k in range(m):
                            value -= half[r, k] * half[c, k]
                            other -= gain[kind, past, r, k] * cov[i, n + k, c]
                        later_cov[kind, past, r, c] = value
                        later_cross[kind, past, r, c] = other
    smoothed = np.zeros((candidates, lag, n))
    for h in range(candidates):
        if row[h] < 0:
            continue
        i, kind, into = component[h], source[h], row[h]
        for c in range(n + m):
            newest[into, c] += weight[h] / total[into] * hypothesis_mean[h, c]
        if group[h] >= 0:
            innovate(model, z[b, group[h]], mean[i], innovation)
        for past in range(lag):
            share = weight[h] * before[i, past]
            if share <= 0.0:
                break
            for r in range(n):
                value = past_mean[i, past, r]
                if group[h] >= 0:
                    for k in range(m):
                        value += gain[kind, past, r, k] * innovation[k]
                smoothed[h, past, r] = value
                out_mean[into, past, r] += share * value
            out_begun[into, past] += share
    for into in range(size):
        for past in range(lag):
            if total[into] > 0.0 and out_begun[into, past] > 0.0:
                for r in range(n):
                    out_mean[into, past, r] /= out_begun[into, past]
    for h in range(candidates):
        if row[h] < 0:
            continue
        i, kind, into = component[h], source[h], row[h]
        joint = model.pairwise and group[h] < 0
        for past in range(lag):
            if weight[h] * before[i, past] <= 0.0:
                break
            share = weight[h] * before[i, past] / out_begun[into, past]
            # Members that had not begun by then count as independent of the present: the blocks stay those of one joint
            # Gaussian, which they would not if the begun members' covariance were combined with that of all.
            linked = weight[h] * before[i, past] / total[into]
            for r in range(n):
                spread = smoothed[h, past, r] - out_mean[into, past, r]
                for c in range(n):
                    part = later_cov[kind, past, r, c] if group[h] >= 0 else past_cov[i, past, r, c]
                    out_cov[into, past, r, c] += share * (
                        part + spread * (smoothed[h, past, c] - out_mean[into, past, c])
                    )
                    part = later_cross[kind, past, r, c] if group[h] >= 0 else past_cross[i, past, r, c]
                    out_cross[into, past, r, c] += linked * (part + spread * (hypothesis_mean[h, c] - newest[into, c]))
                if joint:
                    for c in range(n, n + m):
                        apart = hypothesis_mean[h, c] - newest[into, c]
                        out_cross[into, past, r, c] += linked * (past_cross[i, past, r, c] + spread * apart)
    for into in range(size):
        if total[into] > 0.0:
            for past in range(lag):
                out_begun[into, past] /= total[into]


@njit(cache=True, nogil=True)
def split_components(pool, past, probability, out_pool, out_past):  # type: ignore[no-untyped-def]
    """Write every component twice, with its history: the first shall not maneuver, the second shall.

    Args:
        pool: `Mixture` of the tracks.
        past: `History` of its components.
        probability: Probability of a maneuver.
        out_pool: Output: `Mixture` with twice the rows.
        out_past: Output: `History` with twice the rows.
    """
    for b in range(pool.number.shape[0]):
        out_pool.number[b] = 2 * pool.number[b]
        for i in range(pool.number[b]):
            for twin in range(2):
                row = 2 * i + twin
                out_pool.weight[b, row] = pool.weight[b, i] * (probability if twin == 1 else 1.0 - probability)
                out_pool.mean[b, row] = pool.mean[b, i]
                out_pool.covariance[b, row] = pool.covariance[b, i]
                out_pool.detected[b, row] = pool.detected[b, i]
                out_pool.label[b, row] = pool.label[b, i]
                out_past.begun[b, row] = past.begun[b, i]
                out_past.mean[b, row] = past.mean[b, i]
                out_past.covariance[b, row] = past.covariance[b, i]
                out_past.cross[b, row] = past.cross[b, i]


@njit(cache=True, nogil=True)
def add_maneuver_noise(model, noise, predicted):  # type: ignore[no-untyped-def]
    """Add the noise of a maneuver, shape (n, n), to every second predicted component; see `split_components`."""
    n = model.observation.shape[1]
    for b in range(predicted.number.shape[0]):
        for row in range(1, predicted.number[b], 2):
            for r in range(n):
                for c in range(n):
                    predicted.covariance[b, row, r, c] += noise[r, c]
            attach_measurement(model, predicted.mean[b, row], predicted.covariance[b, row])
