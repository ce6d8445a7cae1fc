"""Prior and process noise of the total image Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.jacobian.alignment import AlignmentState
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class JacobianPrior:
    """Mean and spread of the total image Jacobian before the first increment.

    Args:
        joint_spread: Standard deviation of an entry of J_theta, px/rad. Larger values learn faster from the first
            increments.
        time_spread: Standard deviation of an entry of J_t, px/s.
        mean: Initial Jacobian as nested tuples or an array; None: zero, a cold start. Shape (m, n + 1).
    """

    joint_spread: float = 300.0
    time_spread: float = 200.0
    mean: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        for name, value in (("joint_spread", self.joint_spread), ("time_spread", self.time_spread)):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")
        if self.mean is not None and not np.isfinite(np.asarray(self.mean, dtype=np.float64)).all():
            raise ValueError(f"mean must be finite, got {self.mean}; pass None for a cold start")

    def deviations(self, joints: int) -> Array:
        """Prior standard deviation of each column. Shape (n + 1,)."""
        return np.append(np.full(joints, self.joint_spread), self.time_spread)

    def moments(self, alignment: AlignmentState) -> tuple[Array, Array]:
        """Mean of the Jacobian and covariance of its rows.

        Args:
            alignment: Initial state of the alignment, which has the measurement's shapes.

        Returns:
            The mean, shape (*batch, m, n + 1), and the covariance of each row, shape (*batch, n + 1, n + 1).

        Raises:
            ValueError: `mean` does not have the measurement's m and n.
        """
        *batch, n = alignment.frame_joints.shape
        m = alignment.frame_features.shape[-1]
        mean = np.zeros((m, n + 1)) if self.mean is None else np.asarray(self.mean, dtype=np.float64)
        if mean.shape != (m, n + 1):
            raise ValueError(
                f"mean must have shape (m, n + 1) = {(m, n + 1)} for {n} joints and {m} features, got {mean.shape}"
            )
        covariance = np.diag(self.deviations(n) ** 2)
        return np.tile(mean, (*batch, 1, 1)), np.tile(covariance, (*batch, 1, 1))


@dataclass(frozen=True)
class RandomWalk:
    """Process noise of the Jacobian: x' = x + w (Zhang 2011, eq. 9), independent entries.

    The variance of w grows in proportion to the time between frames, so that a dropped frame adds the right
    uncertainty.

    Args:
        joint_noise: Standard deviation of the change of an entry of J_theta within `period`, px/rad. Larger values
            adapt faster and average fewer frames.
        time_noise: Standard deviation of the change of an entry of J_t within `period`, px/s. It covers the target's
            acceleration and the camera's rotation, so it is larger.
        period: Reference interval of the two, s.
    """

    joint_noise: float = 5.0
    time_noise: float = 40.0
    period: float = 0.05

    def __post_init__(self) -> None:
        for name, value in (("joint_noise", self.joint_noise), ("time_noise", self.time_noise)):
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {value}")
        if not 0.0 < self.period < np.inf:
            raise ValueError(f"period must be finite and > 0 s, got {self.period}")

    def variances(self, joints: int) -> Array:
        """Variance of the change of each column within `period`. Shape (n + 1,)."""
        return np.append(np.full(joints, self.joint_noise**2), self.time_noise**2)

    def deviations(self, joints: int, duration: Array) -> Array:
        """Standard deviation of the change of each column within `duration` (*batch,) s. Shape (*batch, n + 1)."""
        return np.sqrt(self.variances(joints) * (duration / self.period)[..., None])

    def widened(self, covariance: Array, duration: Array) -> Array:
        """Covariance after some time without a measurement. Shape (*batch, n + 1, n + 1).

        Args:
            covariance: Covariance of the rows of the Jacobian. Shape (*batch, n + 1, n + 1).
            duration: Time without a measurement. Shape (*batch,), s.
        """
        wider = covariance.copy()
        diagonal = np.einsum("...ii->...i", wider)
        diagonal += self.variances(covariance.shape[-1] - 1) * (duration / self.period)[..., None]
        return wider
