"""Marginal probabilities of data association by loopy belief propagation (Williams and Lau 2014)."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def association_marginals(  # type: ignore[no-untyped-def]
    track, measurement, psi, tracks, measurements, tolerance=1e-6, iterations=1000
):
    """Marginal probabilities of the association of tracks to measurements, at most one to one.

    Args:
        track: Index of the track of each pair, ascending. Shape (P,).
        measurement: Index of the measurement of each pair. Shape (P,).
        psi: Weight of "track i caused measurement j", divided by the weights of "track i is missed" and
            "measurement j is new or clutter". Shape (P,).
        tracks: Number of tracks, T.
        measurements: Number of measurements, Z.
        tolerance: Largest relative change of a message at which the iteration stops. Raising it makes the marginals
            less exact and the function faster.
        iterations: Largest number of iterations. The iteration is a contraction; it converges slowly where many tracks
            compete for many measurements.

    Returns:
        missed (T,): probability that a track caused no measurement; assigned (P,): probability of each pair; fresh
        (Z,): probability that no track caused the measurement.
    """
    pairs = track.shape[0]
    mu = np.zeros(pairs)
    nu = np.ones(pairs)
    by_track = np.zeros(tracks)
    by_measurement = np.zeros(measurements)
    for _ in range(iterations):
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
        if change < tolerance:
            break
    by_track[:] = 0.0
    for p in range(pairs):
        by_track[track[p]] += psi[p] * nu[p]
    assigned = np.empty(pairs)
    for p in range(pairs):
        assigned[p] = psi[p] * nu[p] / (1.0 + by_track[track[p]])
    return 1.0 / (1.0 + by_track), assigned, 1.0 / (1.0 + by_measurement)
