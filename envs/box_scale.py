"""Map between a bounded Box in physical units and the Box [-1, 1] that reinforcement learning libraries expect."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.types import Array, FloatArray


class BoxScale:
    """Map between a finite Box of any shape and the flat Box [-1, 1] of float32.

    Args:
        space: The bounded Box.
        name: Name of the space in the error message.

    Raises:
        TypeError: Another space, an infinite bound, or an entry whose bounds are equal.
    """

    def __init__(self, space: gym.Space[Any], name: str) -> None:
        if not isinstance(space, gym.spaces.Box) or not space.is_bounded() or not (space.high > space.low).all():
            raise TypeError(f"{name} space must be a Box with finite bounds, low < high, got {space}")
        self.shape = space.shape
        self._low, self._span = space.low.astype(np.float64), space.high.astype(np.float64) - space.low
        self.space = gym.spaces.Box(-1.0, 1.0, (int(np.prod(space.shape)),), np.float32)

    def flat(self, values: NDArray[Any]) -> FloatArray:
        """Return physical values as flat rows in [-1, 1]; leading axes are kept."""
        scaled = 2.0 * (values - self._low) / self._span - 1.0
        batch = values.shape[: values.ndim - len(self.shape)]
        return scaled.reshape(*batch, -1).astype(np.float32)

    def restored(self, values: NDArray[Any]) -> Array:
        """Return flat rows, clipped to [-1, 1], as physical values; leading axes are kept."""
        flat = np.clip(np.asarray(values, dtype=np.float64), -1.0, 1.0)
        return self._low + 0.5 * (flat.reshape(*flat.shape[:-1], *self.shape) + 1.0) * self._span
