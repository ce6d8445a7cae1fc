"""Cramer-Rao bound of a bearing: what the spectra at the elements of a line array say about it, whatever the tracker.

A tone of constant amplitude and unknown phase is a deterministic signal, a broadband sound a stochastic one (Stoica and
Nehorai 1990). Everything but the bearing is known here: the powers, and all other sources. Beam powers are made of the
spectra, so they say no more.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from servotrack.estimators.sonar.array import LineArray
from servotrack.estimators.types import Array


def bearing_information(
    array: LineArray, frequencies: ArrayLike, ratio: ArrayLike, bearings_deg: ArrayLike, snapshots: int, tonal: bool
) -> Array:
    """Fisher information of a bearing in one record.

    Args:
        array: Line array of the receiver.
        frequencies: Frequencies of the bins, Hz. Shape (F,).
        ratio: Power of the source over that of the noise in each bin, per element. Shape (F,).
        bearings_deg: Bearings, deg. Shape (*batch,).
        snapshots: Number K of independent snapshots in the record.
        tonal: True for a tone, False for Gaussian sound.

    Returns:
        2 K sum_f ratio |da/dtheta|^2, for Gaussian sound with ratio^2 N / (1 + N ratio) in place of the ratio. Shape
        (*batch,), 1/deg^2.

    Raises:
        ValueError: Frequencies and ratio have different shapes, a ratio is negative, or there is no snapshot.
    """
    f, rho = np.asarray(frequencies, dtype=np.float64), np.asarray(ratio, dtype=np.float64)
    if f.ndim != 1 or rho.shape != f.shape:
        raise ValueError(f"ratio must have the shape of frequencies, {f.shape}, got {rho.shape}")
    if not np.all(np.isfinite(rho) & (rho >= 0.0)):
        raise ValueError(f"ratio must be finite and >= 0, got {rho.min()}")
    if snapshots < 1:
        raise ValueError(f"snapshots must be at least 1, got {snapshots!r}")
    N = array.elements
    useful = rho if tonal else rho * rho * N / (1.0 + rho * N)
    # Sum over the elements of the squared distance from their middle, in wavelengths per bin.
    spread = N * (N * N - 1) / 12.0 * (2.0 * math.pi * f * array.spacing / array.sound_speed) ** 2
    sine = np.sin(np.radians(np.asarray(bearings_deg, dtype=np.float64)))
    return np.asarray(2.0 * snapshots * float(useful @ spread) * (math.pi / 180.0) ** 2 * sine * sine)


def expected_deviation(variance: ArrayLike, cutoff: float) -> Array:
    """Expected value of min(c, |x|) of a centered Gaussian number.

    Args:
        variance: Variances. Shape (*batch,).
        cutoff: c.

    Raises:
        ValueError: The cutoff is not positive, or a variance is negative.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff must be > 0, got {cutoff!r}")
    v = np.asarray(variance, dtype=np.float64)
    if not np.all(v >= 0.0):
        raise ValueError(f"variance must be >= 0, got {v.min()}")
    deviation = np.maximum(np.sqrt(v), 1e-300)
    share = cutoff / deviation
    inside = deviation * math.sqrt(2.0 / math.pi) * -np.expm1(-0.5 * np.minimum(share, 1e150) ** 2)
    return np.asarray(inside + cutoff * (1.0 - erf(share / math.sqrt(2.0))))
