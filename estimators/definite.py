"""Repair of covariances that rounding has left indefinite.

A measurement that is far more precise than the prediction leaves a variance that is a small difference of large numbers
(a ratio beyond 1e12 or so, in practice after an absurd jump of an input). Then no form of the update keeps a float64
covariance definite: what is left of small eigenvalues is rounding. The functions here find such matrices by a Cholesky
decomposition and reduce their correlations just as far as necessary. All other matrices stay as they are to the bit.
"""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

LEAST_SHARE = 1e-12
"""Smallest share of its reference that a repaired variance keeps, and smallest pivot as a share of its variance."""


def keep_definite(covariances: Array, reference: Array) -> Array:
    """Repair indefinite matrices in place, and return the array.

    Args:
        covariances: Hermitian matrices in C order; changed. Shape (*batch, d, d).
        reference: Variances before the update, positive. Shape (*batch, d).
    """
    d = covariances.shape[-1]
    _keep_definite(covariances.reshape(-1, d, d), np.ascontiguousarray(reference).reshape(-1, d))
    return covariances


@njit(cache=True, nogil=True)
def _keep_definite(covariances, reference):  # type: ignore[no-untyped-def]
    factor = np.empty_like(covariances[0]) if len(covariances) else np.empty_like(covariances).reshape((0, 0))
    for n in range(covariances.shape[0]):
        # NumPy's decomposition of a repaired matrix must succeed too, whose rounding errors differ.
        if not is_definite(covariances[n], LEAST_SHARE, factor):
            repair(covariances[n], reference[n], factor)


@njit(cache=True, nogil=True)
def is_definite(matrix, least, factor):  # type: ignore[no-untyped-def]
    """Return True if all pivots of the decomposition L D L^H exceed the share `least` of their variances.

    Args:
        matrix: Hermitian matrix. Shape (d, d).
        least: Smallest pivot as a share of the variance, not included.
        factor: Scratch for L and D. Shape (d, d).
    """
    for c in range(matrix.shape[0]):
        pivot = matrix[c, c].real
        for k in range(c):
            pivot -= (factor[c, k] * np.conj(factor[c, k])).real * factor[k, k].real
        if not pivot > least * matrix[c, c].real:
            return False
        factor[c, c] = pivot
        for r in range(c + 1, matrix.shape[0]):
            value = matrix[r, c]
            for k in range(c):
                value -= factor[r, k] * np.conj(factor[c, k]) * factor[k, k].real
            factor[r, c] = value / pivot
    return True


@njit(cache=True, nogil=True)
def repair(matrix, reference, factor):  # type: ignore[no-untyped-def]
    """Make a matrix definite in place: raise variances to a share of the reference and reduce correlations.

    Args:
        matrix: Hermitian matrix; changed. Shape (d, d).
        reference: Positive variances of the size from which the matrix was computed. Shape (d,).
        factor: Scratch. Shape (d, d).
    """
    d = matrix.shape[0]
    for r in range(d):
        variance = max(matrix[r, r].real, LEAST_SHARE * reference[r])
        for c in range(d):
            matrix[r, c] = 0.5 * (matrix[r, c] + np.conj(matrix[c, r]))
            matrix[c, r] = np.conj(matrix[r, c])
        matrix[r, r] = variance
    for r in range(d):
        for c in range(r):
            largest = math.sqrt(matrix[r, r].real) * math.sqrt(matrix[c, c].real)
            size = abs(matrix[r, c])
            if not size <= largest:
                matrix[r, c] = matrix[r, c] * (largest / size)
                matrix[c, r] = np.conj(matrix[r, c])
    share = LEAST_SHARE
    while share < 1.0 and not is_definite(matrix, 10.0 * LEAST_SHARE, factor):
        _scale_correlations(matrix, 1.0 - share)
        share *= 4.0
    if not is_definite(matrix, 10.0 * LEAST_SHARE, factor):
        _scale_correlations(matrix, 0.0)


@njit(cache=True, nogil=True)
def _scale_correlations(matrix, share):  # type: ignore[no-untyped-def]
    for r in range(matrix.shape[0]):
        for c in range(r):
            matrix[r, c] *= share
            matrix[c, r] = np.conj(matrix[r, c])
