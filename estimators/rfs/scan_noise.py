"""Noise of single measurements: a scan whose measurements are not equally exact."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.gaussians import PackedModel
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


def no_excess(batch: int, m: int) -> Array:
    """Excess noise of scans whose measurements all have the model's noise."""
    return np.zeros((batch, 0, m, m))


def read_noise(noise: ArrayLike, measurement: ArrayLike, model: PackedModel) -> Array:
    """Noise of each measurement in excess of the model's, in the order of `read_measurements`.

    Args:
        noise: Covariances R_j, symmetric and positive definite; those of unused rows are never read. Shape (Z, m, m)
            for one run, (B, n_max, m, m) for a batch.
        measurement: The measurements, which `read_measurements` has taken.
        model: The packed model.

    Returns:
        R_j - R, zero in unused rows. Shape (B, Z, m, m).

    Raises:
        ValueError: The model is pairwise, the shape is wrong, or a covariance is not positive definite.
    """
    if model.pairwise:
        raise ValueError(
            "noise must be None under a pairwise Markov model, whose noises of state and measurement depend on each "
            "other; use its hidden Markov model"
        )
    R, z, covariance = model.measurement_noise, as_numbers("measurements", measurement), as_numbers("noise", noise)
    m = len(R)
    wanted = (0, m, m) if z.shape == (0,) else (*z.shape[:-1], m, m)
    if covariance.shape != wanted and not (covariance.size == 0 and wanted[0] == 0):
        raise ValueError(
            f"noise must have shape {wanted}, one covariance per measurement, got {covariance.shape}; pass None if all "
            "measurements have the noise of the model"
        )
    covariance = covariance.reshape(len(z) if z.ndim == 3 else 1, *wanted[-3:])
    used = np.ones(covariance.shape[:2], np.bool_)
    if z.ndim == 3:
        order = np.argsort(z[:, :, 0] != 1.0, axis=1, kind="stable")
        covariance = np.take_along_axis(covariance, order[:, :, None, None], axis=1)
        used = np.take_along_axis(z[:, :, 0] == 1.0, order, axis=1)
    _check_covariances(covariance[used], float(np.trace(R)) / m)
    return np.ascontiguousarray(np.where(used[:, :, None, None], covariance - R, 0.0))


def _check_covariances(covariances: Array, usual: float) -> None:
    """Raise ValueError unless all are symmetric and definite, and not negligible beside the usual variance."""
    if len(covariances) == 0:
        return
    check_within("noise", covariances, LIMITS.coordinates**2, "leave such measurements out")
    scale = np.abs(covariances).max(axis=(1, 2))
    apart = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    if np.any(apart > 1e-9 * scale):
        bad = covariances[int(np.argmax(apart / scale))]
        raise ValueError(f"noise must be symmetric, got {bad.tolist()}")
    smallest = np.linalg.eigvalsh(covariances)[:, 0]
    # The kernels add R_j - R to a covariance that contains R: what is lost in its rounding cannot be told from zero.
    least = 1e-9 * np.maximum(scale, usual)
    if np.any(smallest <= least):
        bad = int(np.argmin(smallest - least))
        raise ValueError(
            f"noise must be positive definite, here with eigenvalues above {least[bad]:.3g}, got {smallest[bad]:.3g} "
            f"for measurement {bad}; add variance to its diagonal"
        )
