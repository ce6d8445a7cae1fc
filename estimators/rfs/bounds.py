"""Bounds on what any tracker can reach: the error of one that knows which measurement is whose, and who exists.

Given the association and the existence, the posterior of a linear Gaussian target is exactly Gaussian, and no estimator
without that knowledge has a smaller expected distance. For a symmetric unimodal posterior the mean minimizes
E min(c, |x - a|), so the bound needs covariances only, which depend on the sequence of detections and not on the
measured values.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from servotrack.estimators.rfs.gaussians import LINEAR
from servotrack.estimators.rfs.models import HiddenMarkovModel, PairwiseMarkovModel
from servotrack.estimators.types import Array, Mask

Linear = HiddenMarkovModel | PairwiseMarkovModel


def expected_distance(covariance: Array, cutoff: float) -> Array:
    """Expected distance min(c, |x|) of a centered Gaussian in the plane.

    With x = L u, |x| is the radius of u, which is Rayleigh distributed, times a factor g that depends on the direction
    only; E min(c / g, radius) is an error function, and the mean over directions converges exponentially fast.

    Args:
        covariance: Shape (*batch, 2, 2), m^2.
        cutoff: c, m.

    Returns:
        Shape (*batch,), m.

    Raises:
        ValueError: The cutoff is not positive, or the covariance has another shape.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff must be > 0, got {cutoff!r}")
    P = np.asarray(covariance, dtype=np.float64)
    if P.shape[-2:] != (2, 2):
        raise ValueError(f"covariance must have shape (..., 2, 2), got {P.shape}")
    values = np.maximum(np.linalg.eigvalsh(P), 0.0)
    # Half a turn has all factors.
    angle = (np.arange(512) + 0.5) * math.pi / 512
    factor = np.sqrt(values[..., :1] * np.cos(angle) ** 2 + values[..., 1:] * np.sin(angle) ** 2)
    factor = np.maximum(factor, 1e-300)
    reached = math.sqrt(math.pi / 2.0) * factor * erf(cutoff / (math.sqrt(2.0) * factor))
    return np.asarray(reached.mean(axis=-1))


def known_covariances(
    model: Linear, birth_covariance: Array, detected: Mask, lag: int = 0, transitions: Array | None = None
) -> Array:
    """Covariances of the state of a target whose detections are known, at each scan of its life.

    Args:
        model: Motion and measurement of the target.
        birth_covariance: Covariance of its first state. Shape (n, n).
        detected: Scans with its measurement, from its first to its last. Shape (S,), bool.
        lag: Number of later scans that the estimate may use (Rauch, Tung and Striebel 1965).
        transitions: Transition of the pair of state and measurement into each scan, of which the first is not used;
            None: that of the model. Shape (S, n + m, n + m).

    Returns:
        Shape (S, n, n).

    Raises:
        ValueError: The model is not linear, the lag is negative, or transitions have another shape.
    """
    packed = model.packed
    if packed.kind != LINEAR:
        raise ValueError(f"model must be linear, got {type(model).__name__}: only then are the posteriors Gaussian")
    if lag < 0:
        raise ValueError(f"lag must be at least 0, got {lag!r}")
    m, n = packed.observation.shape
    sigma, scans = packed.noise, len(detected)
    given, shape = packed.transition if transitions is None else np.asarray(transitions), (scans, n + m, n + m)
    if transitions is not None and given.shape != shape:
        raise ValueError(f"transitions must have shape {shape}, one per scan, got {given.shape}")
    moves = np.broadcast_to(given, shape)
    predicted, filtered = np.empty((scans, n + m, n + m)), np.empty((scans, n + m, n + m))
    H = packed.observation
    P = np.zeros((n + m, n + m))
    P[:n, :n], P[n:, :n] = birth_covariance, H @ birth_covariance
    P[:n, n:], P[n:, n:] = P[n:, :n].T, H @ birth_covariance @ H.T + packed.measurement_noise
    for k in range(scans):
        predicted[k] = filtered[k] = P
        if detected[k]:
            gain = np.linalg.solve(P[n:, n:], P[n:, :n]).T
            filtered[k] = 0.0
            filtered[k, :n, :n] = P[:n, :n] - gain @ P[n:, :n]
        if k + 1 < scans:
            P = moves[k + 1] @ filtered[k] @ moves[k + 1].T + sigma
    smoothed = filtered.copy()
    back = [filtered[k] @ np.linalg.solve(predicted[k + 1], moves[k + 1]).T for k in range(scans - 1)]
    for k in range(scans):
        last = min(k + lag, scans - 1)
        P = filtered[last]
        for j in range(last - 1, k - 1, -1):
            P = filtered[j] + back[j] @ (P - predicted[j + 1]) @ back[j].T
        smoothed[k] = P
    return smoothed[:, :n, :n]
