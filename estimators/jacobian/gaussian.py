"""Log likelihood and NIS of a Gaussian innovation, and the check that a matrix is a covariance."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.types import Array, Mask


def correlated_scores(innovation: Array, covariance: Array, used: Mask) -> tuple[Array, Array]:
    """Log likelihood and normalized innovation squared (NIS); both are 0 where no measurement was used.

    Args:
        innovation: Measurement minus prediction. Shape (*batch, m).
        covariance: Innovation covariance. Shape (*batch, m, m).
        used: Mask of the rows with a measurement. Shape (*batch,), bool.

    Returns:
        Log density, and NIS divided by m. Shape (*batch,) each.
    """
    m = innovation.shape[-1]
    squared = np.einsum("...i,...i->...", innovation, np.linalg.solve(covariance, innovation[..., None])[..., 0])
    log_determinant = np.linalg.slogdet(covariance)[1]
    log_likelihood = -0.5 * (squared + log_determinant + m * np.log(2.0 * np.pi))
    return np.where(used, log_likelihood, 0.0), np.where(used, squared / m, 0.0)


def require_positive_definite(name: str, covariance: Array) -> None:
    """Check that a matrix is a covariance: finite, symmetric and positive definite.

    Args:
        name: Name of the argument, with which the error message begins.
        covariance: Matrix to check. Shape (d, d).

    Raises:
        ValueError: The matrix is not finite, symmetric and positive definite.
    """
    if covariance.ndim != 2 or covariance.shape[0] != covariance.shape[1]:
        raise ValueError(f"{name} must be a square matrix, got shape {covariance.shape}")
    if not np.isfinite(covariance).all():
        raise ValueError(f"{name} must be finite, got {covariance.tolist()}")
    if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} must be symmetric, got {covariance.tolist()}; pass 0.5 * (C + C.T)")
    smallest = np.linalg.eigvalsh(covariance)[0]
    if smallest <= 0.0:
        raise ValueError(
            f"{name} must be positive definite, got {covariance.tolist()} with the eigenvalue {smallest:.3g}; "
            "add a small variance to its diagonal"
        )
