"""Beam powers for arrays of any elements: conventional and minimum-variance (MVDR) beamforming of snapshots."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.sonar.array import LineArray, Shading, beam_correlation, beamform, shading_weights
from servotrack.estimators.sonar.elements import AnyArray, phases
from servotrack.estimators.types import Array

Beamformer = Literal["conventional", "mvdr"]


def element_weights(array: AnyArray, shading: Shading = "conventional") -> Array:
    """Weights of the elements, of unit norm. Shape (N,).

    Raises:
        ValueError: Chebyshev shading of elements that are not a uniform line, or an unknown shading.
    """
    if isinstance(array, LineArray):
        return shading_weights(array, shading)
    if shading != "conventional":
        raise ValueError(f"shading of elements at given places must be conventional, got {shading!r}")
    return np.full(array.elements, 1.0 / np.sqrt(array.elements))


def beam_powers(
    array: AnyArray,
    frequencies: ArrayLike,
    snapshots: NDArray[np.complexfloating],
    beam_deg: ArrayLike,
    beamformer: Beamformer = "conventional",
    shading: Shading = "conventional",
) -> Array:
    """Beam powers of one record or many, averaged over frequencies.

    Args:
        array: Line array or elements at given places.
        frequencies: Centers of the band's bins, Hz. Shape (F,).
        snapshots: Spectra at the elements. Shape (*records, K, F, N), complex.
        beam_deg: Directions of the beams, deg. Shape (beams,).
        beamformer: `conventional`: mean over snapshots of |w^H x|^2. `mvdr`: 1 / (w^H R^-1 w) with the covariance R of
            `loaded_covariance` (Capon, Proc. IEEE 57, 1969), which has lower sidelobes and narrower beams.
        shading: Shading of the elements; only `conventional` for MVDR and for elements at given places.

    Returns:
        Powers, 1 in white noise of power 1. Shape (*records, beams).

    Raises:
        ValueError: The snapshots do not have these numbers of frequencies and elements, or an unknown beamformer.
    """
    if beamformer not in get_args(Beamformer):
        raise ValueError(f"beamformer must be one of {', '.join(get_args(Beamformer))}, got {beamformer!r}")
    if beamformer == "conventional" and isinstance(array, LineArray):
        return beamform(array, frequencies, snapshots, beam_deg, shading)
    x = np.asarray(snapshots)
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    if x.ndim < 3 or x.shape[-2:] != (len(f), array.elements):
        raise ValueError(f"snapshots must have shape (*records, K, {len(f)}, {array.elements}), got {x.shape}")
    steered = phases(array, f, beam_deg) * element_weights(
        array, shading if beamformer == "conventional" else "conventional"
    )
    records = x.reshape(-1, *x.shape[-3:])
    powers = np.zeros((len(records), steered.shape[1]))
    for power, record in zip(powers, records, strict=True):
        for at, spectra in enumerate(record.transpose(1, 0, 2)):
            if beamformer == "conventional":
                power += (np.abs(spectra @ steered[at].conj().T) ** 2).mean(axis=0)
            else:
                root = np.linalg.cholesky(loaded_covariance(spectra))
                white = np.linalg.solve(root, steered[at].T)
                power += 1.0 / (np.abs(white) ** 2).sum(axis=0)
    return powers.reshape(*x.shape[:-3], steered.shape[1]) / len(f)


def loaded_covariance(snapshots: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
    """Covariance of the elements with the diagonal loading that minimizes its expected squared error.

    R = (1 - s) S + s (tr S / N) I with the sample covariance S. The share s is estimated from the scatter of the
    snapshots about S (Ledoit and Wolf, J. Multivariate Analysis 88, 2004), so that few snapshots are loaded more and a
    loud source less. The trace, the mean power of the elements, stays.

    Args:
        snapshots: Spectra of one bin at the elements. Shape (K, N), complex.

    Returns:
        Positive definite covariance. Shape (N, N), complex.
    """
    x = np.asarray(snapshots, np.complex128)
    K, N = x.shape
    S = x.T @ x.conj() / K
    mean = float(S.trace().real) / N
    squared = float((np.abs(S) ** 2).sum())
    away = squared - N * mean**2
    scatter = (float(((np.abs(x) ** 2).sum(axis=1) ** 2).sum()) / K - squared) / K
    share = 1.0 if away <= 0.0 else min(max(scatter / away, 1e-6), 1.0)
    # Silence has no covariance; any positive one gives powers of 0 beside it.
    return (1.0 - share) * S + max(share * mean, 1e-30) * np.eye(N)


def noise_correlation(
    array: AnyArray, frequencies: ArrayLike, beam_deg: ArrayLike, shading: Shading = "conventional"
) -> Array:
    """Correlation of the conventional powers of two beams in white noise. Shape (beams, beams)."""
    if isinstance(array, LineArray):
        return beam_correlation(array, frequencies, beam_deg, shading)
    w = element_weights(array, shading)
    f = np.atleast_1d(np.asarray(frequencies, np.float64))
    total = np.zeros((len(np.atleast_1d(beam_deg)),) * 2)
    for one in f:
        beams = phases(array, [one], beam_deg)[0] * w
        total += np.abs(beams.conj() @ beams.T) ** 2
    return total / len(f)
