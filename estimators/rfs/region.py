"""Survival of targets that count only inside a region, such as a sensor's field of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from servotrack.estimators.rfs.interacting import Model, hidden_motion
from servotrack.estimators.types import Array


@dataclass(frozen=True, eq=False)
class RegionSurvival:
    """Survival probability of targets that end when they leave a box of positions; for `survival` of a set filter.

    A target survives with probability `survival` times the probability that its next position lies in the box. The
    next position is normal around that of the straight motion, with the model's process noise.

    Args:
        model: Motion of one target, whose observation selects the position from the state.
        survival: Survival probability inside the region, in [0, 1].
        low: Lowest position. Shape (d,).
        high: Highest position. Shape (d,).

    Raises:
        ValueError: An argument has a wrong shape or is out of range.
    """

    model: Model
    survival: float
    low: Array
    high: Array

    def __post_init__(self) -> None:
        d = self.model.packed.observation.shape[0]
        if not 0.0 <= self.survival <= 1.0:
            raise ValueError(f"survival must be in [0, 1], got {self.survival!r}")
        low, high = np.array(self.low, dtype=np.float64), np.array(self.high, dtype=np.float64)
        if low.shape != (d,) or high.shape != (d,) or not np.all(low < high):
            raise ValueError(f"low and high must have shape ({d},) with low < high, got {self.low!r} and {self.high!r}")
        F, Q = hidden_motion(self.model)
        H = self.model.packed.observation
        deviation = np.sqrt(np.diag(H @ Q @ H.T))
        if not np.all(deviation > 0.0):
            raise ValueError(f"model must have process noise in every coordinate of the position, got {deviation}")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        object.__setattr__(self, "_motion", (H @ F, deviation))

    def __call__(self, states: Array) -> Array:
        """Survival probability of each state, (k, n) to (k,)."""
        forward, deviation = self.__dict__["_motion"]
        position = np.einsum("rc,kc->kr", forward, states)
        below, above = (position - self.low) / deviation, (self.high - position) / deviation
        inside = np.maximum(ndtr(below) + ndtr(above) - 1.0, 0.0)
        return np.asarray(self.survival * inside.prod(axis=1))
