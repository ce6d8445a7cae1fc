"""Models of measurement noise with outliers, for the filters that share one covariance.

Both models keep the Kalman update and only raise the variance of a measurement with a large innovation. They compute
the variance by a fixed-point iteration on the residual after the update. With one covariance for all features the
iteration has one unknown, and a frame is down-weighted as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servotrack.estimators.types import Array


class OutlierModel(Protocol):
    """Interface of the noise models."""

    def variance(self, power: Array, spread: Array, nominal: float, features: int) -> Array:
        """Compute the variance to use for one measurement.

        Args:
            power: Mean square of the m innovations. Shape (*batch,), px^2.
            spread: Variance of each innovation due to the uncertain state. Shape (*batch,), px^2.
            nominal: Measurement variance without outliers, px^2.
            features: Number m of features.

        Returns:
            Measurement variance, at least about `nominal`. Shape (*batch,), px^2.
        """


@dataclass(frozen=True)
class StudentTNoise:
    """Multivariate Student-t noise, by variational Bayes (Piché, Särkkä and Hartikainen 2012).

    Args:
        degrees_of_freedom: Degrees of freedom. Smaller values down-weight outliers more; for large values the result
            tends to the Kalman filter.
        iterations: Number of fixed-point iterations.
    """

    degrees_of_freedom: float = 4.0
    iterations: int = 5

    def __post_init__(self) -> None:
        if not 0.0 < self.degrees_of_freedom < np.inf:
            raise ValueError(f"degrees_of_freedom must be finite and > 0, got {self.degrees_of_freedom}")
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")

    def variance(self, power: Array, spread: Array, nominal: float, features: int) -> Array:
        """Compute the variance, see `OutlierModel.variance`."""
        variance = np.full(np.shape(power), nominal)
        for _ in range(self.iterations):
            kept = variance / (spread + variance)
            residual = features * (kept**2 * power + kept * spread) / nominal
            variance = nominal * (self.degrees_of_freedom + residual) / (self.degrees_of_freedom + features)
        return variance


@dataclass(frozen=True)
class CorrentropyNoise:
    """Maximum correntropy with a Gaussian kernel on the measurement (after Chen, Liu, Zhao and Principe 2017).

    The original also weights the components of the prior; here only the measurement is weighted.

    Args:
        bandwidth: Width of the kernel, in standard deviations of the measurement noise. Smaller values down-weight
            outliers more; for large values the result tends to the Kalman filter.
        iterations: Number of fixed-point iterations.
        least_weight: Smallest weight of a measurement, in (0, 1]. Larger values learn a changed Jacobian sooner and
            suppress outliers less.
    """

    bandwidth: float = 2.0
    iterations: int = 5
    least_weight: float = 1e-3

    def __post_init__(self) -> None:
        if not 0.0 < self.bandwidth < np.inf:
            raise ValueError(f"bandwidth must be finite and > 0, got {self.bandwidth}")
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        if not 0.0 < self.least_weight <= 1.0:
            raise ValueError(f"least_weight must be in (0, 1], got {self.least_weight}")

    def variance(self, power: Array, spread: Array, nominal: float, features: int) -> Array:
        """Compute the variance, see `OutlierModel.variance`."""
        variance = np.full(np.shape(power), nominal)
        for _ in range(self.iterations):
            kept = variance / (spread + variance)
            weight = np.exp(-0.5 * kept**2 * power / (nominal * self.bandwidth**2))
            variance = nominal / np.maximum(weight, self.least_weight)
        return variance


def robust_variance(
    model: OutlierModel | None, mean: Array, covariance: Array, direction: Array, measured: Array, nominal: float
) -> Array | float:
    """Measurement variance under an outlier model, for z = mean h + noise.

    Args:
        model: Outlier model; None for the plain Kalman gain.
        mean: Predicted mean. Shape (*batch, m, d).
        covariance: Predicted covariance shared by the rows of `mean`. Shape (*batch, d, d).
        direction: h. Shape (*batch, d).
        measured: z. Shape (*batch, m), px.
        nominal: Measurement variance without outliers, px^2.

    Returns:
        Variance: `nominal` without a model, else shape (*batch,), px^2.
    """
    if model is None:
        return nominal
    innovation = measured - np.einsum("...ij,...j->...i", mean, direction)
    spread = np.einsum("...i,...ij,...j->...", direction, covariance, direction)
    return model.variance(np.mean(innovation**2, axis=-1), spread, nominal, measured.shape[-1])
