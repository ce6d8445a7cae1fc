"""Broyden's rank-one update."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.prior import JacobianPrior
from servotrack.estimators.jacobian.shared_covariance import interval
from servotrack.estimators.types import Array


class BroydenState(NamedTuple):
    """State of `BroydenJacobian`.

    Attributes:
        alignment: Encoder history and newest frame.
        jacobian: Shape (*batch, m, n + 1), px/rad and px/s.
        innovation_power: Running mean square of dy - J ds. Shape (*batch,), px^2.
    """

    alignment: AlignmentState
    jacobian: Array
    innovation_power: Array


@dataclass(frozen=True)
class BroydenJacobian:
    """J' = J + mu (dy - J ds) (W ds)' / (ds' W ds + rho^2), W = diag(1, .., 1, w^2).

    Broyden (1965), for visual servoing Hosoda and Asada (1994). W makes rad and s comparable; rho damps the step
    where motion is too small to learn from.

    Args:
        rate: mu, in (0, 1]; 1 explains the newest increment entirely.
        time_weight: w, the motion of a joint that weighs as much as one second, rad/s.
        damping: rho, the motion below which little is learned, rad.
        memory: Share of the innovation's mean square kept at every frame, in [0, 1).
        initial_innovation: Root of that mean square before the first increment, px.
        prior: Its mean is the initial Jacobian; its spreads are not used.
        alignment: Pairing of joints and features by time stamps.
    """

    rate: float = 0.5
    time_weight: float = 2.0
    damping: float = 0.006
    memory: float = 0.9
    initial_innovation: float = 10.0
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if not 0.0 < self.rate <= 1.0:
            raise ValueError(f"rate must be in (0, 1], got {self.rate}")
        if not 0.0 <= self.memory < 1.0:
            raise ValueError(f"memory must be in [0, 1), got {self.memory}")
        for name in ("time_weight", "damping", "initial_innovation"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")

    def initial(self, measurement: ServoMeasurement) -> BroydenState:
        """State before the first increment. Raises ValueError as `checked` does."""
        alignment = self.alignment.initial(measurement)
        mean, _ = self.prior.moments(alignment)
        return BroydenState(alignment, mean, np.full(mean.shape[:-2], self.initial_innovation**2))

    def step(self, state: BroydenState, measurement: ServoMeasurement) -> tuple[BroydenState, LinearEstimate]:
        """Fold one measurement in. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        ds = interval(increment)
        weighted = ds * np.append(np.ones(ds.shape[-1] - 1), self.time_weight**2)
        innovation = increment.features - np.einsum("...ij,...j->...i", state.jacobian, ds)
        gain = self.rate * weighted / (np.einsum("...i,...i->...", ds, weighted) + self.damping**2)[..., None]
        jacobian = state.jacobian + innovation[..., :, None] * gain[..., None, :]

        power = np.mean(innovation**2, axis=-1)
        expected = state.innovation_power
        ratio = power / expected
        log_likelihood = -0.5 * innovation.shape[-1] * (ratio + np.log(2.0 * np.pi * expected))
        # A perfect prediction must not make the next one's likelihood infinite.
        least = (1e-3 * self.initial_innovation) ** 2
        averaged = np.maximum(self.memory * expected + (1.0 - self.memory) * power, least)
        estimate = present_estimate(
            alignment.frame_features,
            jacobian,
            increment,
            measurement.goal,
            np.where(increment.fresh, log_likelihood, 0.0),
            np.where(increment.fresh, ratio, 0.0),
        )
        return BroydenState(alignment, jacobian, np.where(increment.fresh, averaged, expected)), estimate
