"""Compiled kernels of the particle PHD filter: motion, weights, systematic resampling, clustering."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.gaussians import LINEAR, cholesky_inverse


@njit(cache=True, nogil=True)
def predict_particles(transition, root, particles, noise):  # type: ignore[no-untyped-def]
    """Compute F x + L u for every particle. Shapes (n, n), (n, n), (P, n), (P, n) -> (P, n)."""
    count, n = particles.shape
    moved = np.zeros((count, n))
    for p in range(count):
        for r in range(n):
            for k in range(n):
                moved[p, r] += transition[r, k] * particles[p, k] + root[r, k] * noise[p, k]
    return moved


@njit(cache=True, nogil=True)
def _expected_measurement(model, state, out):  # type: ignore[no-untyped-def]
    """Compute H x, or range and bearing of the position."""
    m, n = model.observation.shape
    for r in range(m):
        out[r] = 0.0
        for k in range(n):
            out[r] += model.observation[r, k] * state[k]
    if model.kind != LINEAR:
        dx, dy = out[0] - model.sensor[0], out[1] - model.sensor[1]
        out[0], out[1] = math.hypot(dx, dy), math.atan2(dy, dx)


@njit(cache=True, nogil=True)
def weigh_particles(model, particles, weight, z, clutter, detection):  # type: ignore[no-untyped-def]
    """PHD update of the weights, in place (Vo, Singh and Doucet 2005, eq. 20).

    Args:
        model: The packed model.
        particles: States. Shape (P, n).
        weight: Weights; changed in place. Shape (P,).
        z: Measurements. Shape (Z, m).
        clutter: Clutter intensity kappa.
        detection: Detection probability p_D.
    """
    m = model.observation.shape[0]
    count, number = particles.shape[0], z.shape[0]
    root = np.zeros((m, m))
    log_norm = -cholesky_inverse(model.measurement_noise, m, 0, root) - 0.5 * m * math.log(2.0 * math.pi)
    expected = np.empty(m)
    likelihood = np.empty((count, number))
    evidence = np.full(number, clutter)
    for p in range(count):
        _expected_measurement(model, particles[p], expected)
        for j in range(number):
            distance = 0.0
            for r in range(m):
                value = 0.0
                for k in range(r + 1):
                    innovation = z[j, k] - expected[k]
                    if model.angular[k]:
                        innovation -= 2.0 * math.pi * math.floor(innovation / (2.0 * math.pi) + 0.5)
                    value += root[r, k] * innovation
                distance += value * value
            likelihood[p, j] = math.exp(log_norm - 0.5 * distance) if distance < 1400.0 else 0.0
            evidence[j] += detection * weight[p] * likelihood[p, j]
    for p in range(count):
        factor = 1.0 - detection
        for j in range(number):
            if evidence[j] > 0.0:
                factor += detection * likelihood[p, j] / evidence[j]
        weight[p] *= factor


@njit(cache=True, nogil=True)
def resample_systematically(weight, number, offset):  # type: ignore[no-untyped-def]
    """Draw `number` rows by systematic resampling with one uniform offset in [0, 1); none if all weights are 0."""
    total = weight.sum()
    if not total > 0.0:
        return np.empty(0, np.int64)
    chosen = np.empty(number, np.int64)
    row = 0
    reached = weight[0]
    for k in range(number):
        level = (k + offset) / number * total
        while reached < level and row < weight.shape[0] - 1:
            row += 1
            reached += weight[row]
        chosen[k] = row
    return chosen


@njit(cache=True, nogil=True)
def cluster_particles(  # type: ignore[no-untyped-def]
    observation, particles, weight, label, targets, iterations, next_label, extraction, b
):
    """Weighted k-means of the positions into `targets` clusters; a cluster takes the identity of most of its weight.

    The first center is the heaviest particle, each further one the particle with the largest product of weight and
    squared distance to the nearest center. At most `iterations` Lloyd iterations follow. Particles without an identity
    take that of their cluster. Returns the next new identity.
    """
    count, n = particles.shape
    m = observation.shape[0]
    position = np.zeros((count, m))
    for p in range(count):
        for r in range(m):
            for k in range(n):
                position[p, r] += observation[r, k] * particles[p, k]
    nearest = np.full(count, np.inf)
    owner = np.zeros(count, np.int64)
    centers = np.zeros((targets, m))
    for t in range(targets):
        best, most = 0, -1.0
        for p in range(count):
            value = weight[p] * (nearest[p] if t > 0 else 1.0)
            if value > most:
                best, most = p, value
        centers[t] = position[best]
        for p in range(count):
            distance = np.sum((position[p] - centers[t]) ** 2)
            if distance < nearest[p]:
                nearest[p], owner[p] = distance, t
    mass = np.zeros(targets)
    for _ in range(iterations if targets > 0 else 0):
        mass[:] = 0.0
        centers[:] = 0.0
        for p in range(count):
            mass[owner[p]] += weight[p]
            centers[owner[p]] += weight[p] * position[p]
        for t in range(targets):
            if mass[t] > 0.0:
                centers[t] /= mass[t]
        moved = 0
        for p in range(count):
            best, least = int(owner[p]), np.sum((position[p] - centers[owner[p]]) ** 2)
            for t in range(targets):
                distance = np.sum((position[p] - centers[t]) ** 2)
                if distance < least:
                    best, least = t, distance
            if best != owner[p]:
                owner[p] = best
                moved += 1
        if moved == 0:
            break
    # Clusters choose identities in order of weight, so that the heavier of two with the same identity keeps it.
    mass[:] = 0.0
    for p in range(count):
        if targets > 0:
            mass[owner[p]] += weight[p]
    order = np.argsort(-mass, kind="mergesort")
    row = 0
    for cluster in order:
        if not mass[cluster] > 0.0:
            continue
        members = np.flatnonzero(owner == cluster)
        votes = np.unique(label[members])
        identity, most = 0, 0.0
        for vote in votes:
            support = weight[members[label[members] == vote]].sum()
            if vote > 0 and support > most and not np.any(extraction.label[b, :row] == vote):
                identity, most = int(vote), support
        if identity == 0:
            identity = int(next_label)
            next_label += 1
        for member in members:
            if label[member] == 0 or most == 0.0:
                label[member] = identity
        share = weight[members] / mass[cluster]
        for r in range(n):
            extraction.state[b, row, r] = np.sum(share * particles[members, r])
        for r in range(n):
            for c in range(n):
                spread = (particles[members, r] - extraction.state[b, row, r]) * (
                    particles[members, c] - extraction.state[b, row, c]
                )
                extraction.covariance[b, row, r, c] = np.sum(share * spread)
        extraction.existence[b, row] = min(mass[cluster], 1.0)
        extraction.label[b, row] = identity
        extraction.reported[b, row] = True
        row += 1
    extraction.number[b] = row
    return next_label
