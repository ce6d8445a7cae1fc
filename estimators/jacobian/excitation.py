"""Small exploratory moves that show an estimator all columns of the Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.types import Array, Labels


@dataclass(frozen=True)
class Excitation:
    """One joint at a time, first all of them out, then all of them back, and so on.

    Out and back tells a joint's column from the target's own motion: the sum of the two changes of the features is
    J_t dt alone.

    Args:
        steps: Number of moves; 2 n of them show every column of an n-joint arm twice.
        amplitude: Size of one move, rad.
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
        """Joint rates of one move.

        Args:
            move: Which one, from 0. Shape (*batch,).
            direction: +1 or -1, the way out of each joint. Shape (*batch, n).

        Returns:
            Shape (*batch, n), rad/s.
        """
        joints = direction.shape[-1]
        way = np.where((move // joints) % 2 == 0, 1.0, -1.0)
        chosen = np.arange(joints) == (move % joints)[..., None]
        return np.where(chosen, way[..., None] * direction * (self.amplitude / self.period), 0.0)
