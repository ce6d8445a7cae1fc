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
        innovation_power: Running mean square of the innovation dy - J ds. Shape (*batch,), px^2.
    """

    alignment: AlignmentState
    jacobian: Array
    innovation_power: Array


@dataclass(frozen=True)
class BroydenJacobian:
    """J' = J + mu (dy - J ds) (W ds)' / (ds' W ds + rho^2), W = diag(1, .., 1, w^2).

    Broyden (1965), applied to visual servoing by Hosoda and Asada (1994). W makes rad and s comparable; rho damps the
    step for motions that are small beside the noise.

    Args:
        rate: Step size mu, in (0, 1]. Larger values adapt faster and average less noise; 1 fits the newest increment
            exactly.
        time_weight: Weight w of time, rad/s: the joint motion that weighs as much as one second. Larger values
            attribute more of dy to the target's motion.
        damping: Motion rho below which the step is damped, rad. Larger values learn less from small motions.
        memory: Share of the innovation's mean square kept at every frame, in [0, 1). Larger values average more frames.
        initial_innovation: Root mean square innovation before the first increment, px.
        prior: Prior whose mean is the initial Jacobian. Its spreads are not used.
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
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
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
        # The floor keeps the next likelihood finite after a perfect prediction.
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
