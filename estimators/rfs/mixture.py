"""Gaussian mixtures of fixed capacity as arrays, with kernels that predict them and append births."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.gaussians import attach_measurement, predict_gaussian
from servotrack.estimators.types import Array, Labels, Mask


class Mixture(NamedTuple):
    """Gaussian components over (x, y) of several runs, N = n + m; the first `number` rows of a run are in use.

    Attributes:
        number: Number of components. Shape (*batch,).
        weight: Weights. Shape (*batch, K).
        mean: Means. Shape (*batch, K, N).
        covariance: Covariances, with zero y blocks if y is known exactly or dropped. Shape (*batch, K, N, N).
        detected: Mask of components whose y is known exactly or dropped. Shape (*batch, K), bool.
        label: Identity, 0 for none yet. Shape (*batch, K).
    """

    number: Labels
    weight: Array
    mean: Array
    covariance: Array
    detected: Mask
    label: Labels


def empty_mixture(batch: int, capacity: int, N: int) -> Mixture:
    """Mixtures without components, all entries zero."""
    return Mixture(
        np.zeros(batch, np.int64),
        np.zeros((batch, capacity)),
        np.zeros((batch, capacity, N)),
        np.zeros((batch, capacity, N, N)),
        np.zeros((batch, capacity), np.bool_),
        np.zeros((batch, capacity), np.int64),
    )


def scratch_mixture(batch: int, capacity: int, N: int) -> Mixture:
    """Uninitialized arrays for a prediction; rows from `number` on hold arbitrary values."""
    return Mixture(
        np.empty(batch, np.int64),
        np.empty((batch, capacity)),
        np.empty((batch, capacity, N)),
        np.empty((batch, capacity, N, N)),
        np.empty((batch, capacity), np.bool_),
        np.empty((batch, capacity), np.int64),
    )


@njit(cache=True, nogil=True)
def predict_components(model, mixture, b, work, out):  # type: ignore[no-untyped-def]
    """Predict the Gaussians and labels of run b into the same rows of `out`; the caller sets the weights."""
    for i in range(mixture.number[b]):
        predict_gaussian(
            model,
            mixture.mean[b, i],
            mixture.covariance[b, i],
            mixture.detected[b, i],
            work,
            out.mean[b, i],
            out.covariance[b, i],
        )
        out.label[b, i] = mixture.label[b, i]


@njit(cache=True, nogil=True)
def append_births(model, births, b, row, out):  # type: ignore[no-untyped-def]
    """Append the births of run b (or the shared ones of all runs) from `row` on and return the next free row."""
    n = model.observation.shape[1]
    source = b if births.weight.shape[0] > 1 else 0
    for k in range(births.weight.shape[1]):
        if births.weight[source, k] <= 0.0:
            continue
        out.weight[b, row] = births.weight[source, k]
        out.label[b, row] = 0
        for r in range(n):
            out.mean[b, row, r] = births.mean[source, k, r]
            for c in range(n):
                out.covariance[b, row, r, c] = births.covariance[source, k, r, c]
        attach_measurement(model, out.mean[b, row], out.covariance[b, row])
        row += 1
    return row


@njit(cache=True, nogil=True)
def append_spawn(model, spawns, term, mean, cov, b, row, out):  # type: ignore[no-untyped-def]
    """Append N(d + F_beta m, Q_beta + F_beta P F_beta^T) with its measurement; the caller sets the weight."""
    n = model.observation.shape[1]
    _, offset, transition, noise = spawns
    for r in range(n):
        value = offset[term, r]
        for k in range(n):
            value += transition[term, r, k] * mean[k]
        out.mean[b, row, r] = value
        for c in range(r + 1):
            value = noise[term, r, c]
            for k in range(n):
                for j in range(n):
                    value += transition[term, r, k] * cov[k, j] * transition[term, c, j]
            out.covariance[b, row, r, c] = value
            out.covariance[b, row, c, r] = value
    attach_measurement(model, out.mean[b, row], out.covariance[b, row])
    out.label[b, row] = 0
