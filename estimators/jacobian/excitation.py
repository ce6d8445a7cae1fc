"""Small exploratory moves that excite all columns of the Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.types import Array, Labels


@dataclass(frozen=True)
class Excitation:
    """Exploratory moves of one joint at a time: first all joints outward, then all back, and so on.

    The moves outward and back separate a joint's column from the target's motion: the sum of the two changes of the
    features is J_t dt alone.

    Args:
        steps: Number of moves; 2 n of them excite every column of an n-joint arm twice. 0 disables exploration.
        amplitude: Size of one move, rad. Larger moves stand out better from the noise and disturb the servo more.
        period: Control period, s.
    """

    steps: int = 6
    amplitude: float = 0.04
    period: float = 0.05

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ValueError(f"steps must be >= 0, got {self.steps}")
        for name, value in (("amplitude", self.amplitude), ("period", self.period)):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")

    def rate(self, move: Labels, direction: Array) -> Array:
        """Compute the joint rates of one move.

        Args:
            move: Index of the move, from 0. Shape (*batch,).
            direction: Outward direction of each joint, +1 or -1. Shape (*batch, n).

        Returns:
            Joint rates. Shape (*batch, n), rad/s.
        """
        joints = direction.shape[-1]
        way = np.where((move // joints) % 2 == 0, 1.0, -1.0)
        chosen = np.arange(joints) == (move % joints)[..., None]
        return np.where(chosen, way[..., None] * direction * (self.amplitude / self.period), 0.0)
