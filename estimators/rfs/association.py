"""Marginal probabilities of data association by loopy belief propagation (Williams and Lau 2014)."""

from __future__ import annotations

import numpy as np
from numba import njit

TOLERANCE = 1e-6
"""Largest relative change of a message at which the iteration ends."""

ITERATIONS = 1000
"""The iteration is a contraction, but a slow one where many tracks contest many measurements."""


@njit(cache=True, nogil=True)
def association_marginals(track, measurement, psi, tracks, measurements):  # type: ignore[no-untyped-def]
    """Marginals of the association of tracks to measurements, at most one to one.

    Args:
        track: Track of each pair, ascending. Shape (P,).
        measurement: Measurement of each pair. Shape (P,).
        psi: Weight of "track i caused measurement j" over those of "track i is missed" and "measurement j is new or
            clutter". Shape (P,).
        tracks: Number of tracks, T.
        measurements: Number of measurements, Z.

    Returns:
        missed (T,): probability that a track caused none; assigned (P,); fresh (Z,): probability that no track caused
        the measurement.
    """
    pairs = track.shape[0]
    mu = np.zeros(pairs)
    nu = np.ones(pairs)
    by_track = np.zeros(tracks)
    by_measurement = np.zeros(measurements)
    for _ in range(ITERATIONS):
        by_track[:] = 0.0
        for p in range(pairs):
            by_track[track[p]] += psi[p] * nu[p]
        by_measurement[:] = 0.0
        for p in range(pairs):
            mu[p] = psi[p] / (1.0 + max(by_track[track[p]] - psi[p] * nu[p], 0.0))
            by_measurement[measurement[p]] += mu[p]
        change = 0.0
        for p in range(pairs):
            message = 1.0 / (1.0 + max(by_measurement[measurement[p]] - mu[p], 0.0))
            change = max(change, abs(message - nu[p]) / message)
            nu[p] = message
        if change < TOLERANCE:
            break
    by_track[:] = 0.0
    for p in range(pairs):
        by_track[track[p]] += psi[p] * nu[p]
    assigned = np.empty(pairs)
    for p in range(pairs):
        assigned[p] = psi[p] * nu[p] / (1.0 + by_track[track[p]])
    return 1.0 / (1.0 + by_track), assigned, 1.0 / (1.0 + by_measurement)
