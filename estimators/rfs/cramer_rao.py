"""Posterior Cramer-Rao bounds on the mean squared error of a target that is known to exist, for any sensor.

The information J of a state obeys J' = (F J^-1 F^T + Q)^-1 + q E[H^T R^-1 H] (Tichavsky, Muravchik and Nehorai 1998),
where q says how much of a measurement's information is left when some are missed and clutter stands among them
(Hernandez, Farina and Ristic 2006). J^-1 is a lower bound of the covariance of every estimate's error.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array, Labels, Mask


def information_reduction(
    detection: float, clutter_intensity: float, noise: ArrayLike, *, samples: int = 20_000, seed: int = 0
) -> float:
    """Share q of the information of a sure and clean measurement that a scan holds on average.

    A scan holds the target's measurement with probability p_D among uniform clutter of known intensity; which
    measurement is the target's is not known. In coordinates where the noise is the identity, the gradient of the log
    likelihood is g = sum_i w_i u_i with w_i = p_D N(u_i; 0, 1) / (kappa (1 - p_D) + p_D sum_j N(u_j; 0, 1)), and
    q = E |g|^2 / m, here over simulated scans.

    Args:
        detection: p_D, in (0, 1].
        clutter_intensity: kappa, expected false measurements of a scan per unit of measurement space.
        noise: R. Shape (m, m).
        samples: Number of simulated scans. Raising it lowers the standard error, about 1 / sqrt(samples); the time
            grows with the clutter.
        seed: Seed of the simulation.

    Returns:
        q, from 0 to p_D; p_D without clutter.

    Raises:
        ValueError: An argument is out of range.
    """
    R = np.atleast_2d(np.asarray(noise, dtype=np.float64))
    if not 0.0 < detection <= 1.0:
        raise ValueError(f"detection must be in (0, 1], got {detection!r}")
    if not (math.isfinite(clutter_intensity) and clutter_intensity >= 0.0):
        raise ValueError(f"clutter_intensity must be finite and >= 0, got {clutter_intensity!r}")
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not np.all(np.linalg.eigvalsh(R) > 0.0):
        raise ValueError(f"noise must be a positive definite matrix, got {R.tolist()}")
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples!r}")
    m = len(R)
    clutter = clutter_intensity * math.sqrt(np.linalg.det(2.0 * math.pi * R))
    if clutter == 0.0:
        return float(detection)
    rng = np.random.default_rng(seed)
    # Scans in groups, so that the measurements of dense clutter do not fill the memory.
    group = max(1, min(samples, int(2e6 / (1.0 + _clutter_nearby(clutter, m)))))
    total = 0.0
    for first in range(0, samples, group):
        scans = min(group, samples - first)
        scan, u = whitened_scans(rng, rng.random(scans) < detection, clutter, m)
        ratio = detection / clutter * np.exp(-0.5 * (u * u).sum(axis=1))
        likelihood = 1.0 - detection + np.bincount(scan, ratio, scans)
        for axis in range(m):
            gradient = np.bincount(scan, ratio * u[:, axis], scans)
            total += float((np.divide(gradient, likelihood, out=gradient, where=likelihood > 0.0) ** 2).sum())
    return min(total / (samples * m), float(detection))


def whitened_scans(rng: np.random.Generator, detected: Mask, clutter: float, dimensions: int) -> tuple[Labels, Array]:
    """Simulated measurements near one target, in coordinates where it is at zero and the noise is the identity.

    Args:
        rng: Random numbers.
        detected: Scans with a measurement of the target. Shape (S,), bool.
        clutter: Expected false measurements within the volume sqrt(det(2 pi R)).
        dimensions: Number of coordinates, m.

    Returns:
        Scan of each measurement, shape (Z,), and the measurements, shape (Z, m). Clutter reaches to seven standard
        deviations, beyond which a measurement says nothing about the target.
    """
    m = dimensions
    scan = np.repeat(np.arange(len(detected)), rng.poisson(_clutter_nearby(clutter, m), len(detected)))
    direction = rng.standard_normal((len(scan), m))
    radius = _reach() * rng.random(len(scan)) ** (1.0 / m)
    false = direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius[:, None]
    own = np.flatnonzero(detected)
    return np.concatenate([scan, own]), np.concatenate([false, rng.standard_normal((len(own), m))])


def _reach() -> float:
    """Distance in standard deviations beyond which a measurement says nothing about a target."""
    return 7.0


def _clutter_nearby(clutter: float, m: int) -> float:
    """Expected false measurements within reach of a target."""
    ball = math.pi ** (m / 2) / math.gamma(m / 2 + 1) * _reach() ** m
    return clutter * ball / (2.0 * math.pi) ** (m / 2)


def cramer_rao_covariances(
    transition: ArrayLike,
    process_noise: ArrayLike,
    birth_covariance: ArrayLike,
    information: ArrayLike,
    lag: int = 0,
) -> Array:
    """Lower bounds on the covariance of the error of a target's state at each scan of its life.

    Args:
        transition: F. Shape (n, n), or (S, n, n), the transition into each scan, of which the first is not used.
        process_noise: Q. Shape (n, n).
        birth_covariance: Covariance of the first state. Shape (n, n).
        information: q E[H^T R^-1 H] of each scan: the mean over possible paths for the posterior bound, or along one
            path for that path's. Shape (S, n, n).
        lag: Number of later scans that the estimate may use.

    Returns:
        Shape (S, n, n).

    Raises:
        ValueError: Shapes do not fit, the lag is negative, or the first covariance is not positive definite.
    """
    given = np.asarray(information, dtype=np.float64)
    P = np.asarray(birth_covariance, dtype=np.float64)
    n = P.shape[0]
    Q = np.asarray(process_noise, dtype=np.float64)
    if given.ndim != 3 or given.shape[1:] != (n, n) or Q.shape != (n, n) or P.shape != (n, n):
        raise ValueError(
            f"information must have shape (S, {n}, {n}), process_noise and birth_covariance ({n}, {n}), got "
            f"{given.shape}, {Q.shape} and {P.shape}"
        )
    if lag < 0:
        raise ValueError(f"lag must be at least 0, got {lag!r}")
    if not np.all(np.linalg.eigvalsh(P) > 0.0):
        raise ValueError("birth_covariance must be positive definite")
    scans = len(given)
    F = np.broadcast_to(np.asarray(transition, dtype=np.float64), (scans, n, n))
    predicted, filtered = np.empty((scans, n, n)), np.empty((scans, n, n))
    for k in range(scans):
        if k:
            P = F[k] @ filtered[k - 1] @ F[k].T + Q
        predicted[k] = P
        # (P^-1 + I)^-1 without the inverse of P, which may be nearly singular.
        filtered[k] = np.linalg.solve(np.eye(n) + P @ given[k], P)
        filtered[k] = 0.5 * (filtered[k] + filtered[k].T)
    smoothed = filtered.copy()
    for k in range(scans):
        last = min(k + lag, scans - 1)
        P = filtered[last]
        for j in range(last - 1, k - 1, -1):
            back = np.linalg.solve(predicted[j + 1], F[j + 1] @ filtered[j]).T
            P = filtered[j] + back @ (P - predicted[j + 1]) @ back.T
        smoothed[k] = P
    return smoothed
