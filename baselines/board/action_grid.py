"""Grid of actions: a trace holds the very numbers that reached the environment in two bytes each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.estimators.types import Array, FloatArray


@dataclass(frozen=True)
class ActionGrid:
    """Whole multiples of a share of the action space's half width, counted from its middle.

    Attributes:
        middle: Middle of the action space, flat. Shape (n,).
        half: Half width of the action space, flat. Shape (n,).
        steps: Steps from the middle to a bound; 32,767 for arms means 0.00006 rad/s. Raising it makes actions finer and
            traces larger.
        shape: Shape of an action.
    """

    middle: Array
    half: Array
    steps: int
    shape: tuple[int, ...]

    @classmethod
    def of(cls, space: spaces.Space[Any], steps: int) -> ActionGrid:
        """Return the grid of a bounded Box.

        Raises:
            ValueError: Another space.
        """
        if not isinstance(space, spaces.Box) or not space.is_bounded():
            raise ValueError(f"action_space must be a bounded Box to record actions, got {space}")
        low, high = (np.asarray(bound, np.float64).reshape(-1) for bound in (space.low, space.high))
        return cls((low + high) / 2, (high - low) / 2, steps, space.shape)

    def rounded(self, actions: NDArray[Any]) -> NDArray[np.int16]:
        """Return the nearest grid points.

        Args:
            actions: Actions, shape (N, *shape). Those outside the bounds are moved to the bound.

        Returns:
            Shape (N, n).

        Raises:
            ValueError: A wrong shape, or a number that is not finite.
        """
        values = np.asarray(actions, dtype=np.float64)
        if values.shape[1:] != self.shape:
            raise ValueError(f"action must have shape {self.shape}, got {values.shape[1:]}")
        values = values.reshape(len(values), -1)
        if not np.isfinite(values).all():
            raise ValueError(f"action must be finite, got {values[~np.isfinite(values).all(1)][0].tolist()}")
        shares = np.clip((values - self.middle) / self.half, -1.0, 1.0)
        return np.rint(shares * self.steps).astype(np.int16)

    def actions(self, points: NDArray[np.int16]) -> FloatArray:
        """Return the actions of grid points, float32.

        Args:
            points: Shape (N, n).

        Returns:
            Shape (N, *shape).
        """
        values = self.middle + self.half * (points.astype(np.float64) / self.steps)
        return values.astype(np.float32).reshape(len(points), *self.shape)
