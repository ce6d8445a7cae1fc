"""Random agent: uniform actions, the lower anchor of every score."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.types import Mask


class RandomAgent:
    """Uniform actions as a function of (seed, step, row), independent of all observations and of the number of rows.

    Args:
        env: A Gymnasium environment or vector environment; only its spaces are read.
        seed: Seed of the actions.

    Attributes:
        rows: Numbers of the rows of a batch; None: 0, 1, and so on. The evaluator gives an episode the same number
            whichever others run beside it.

    Raises:
        ValueError: An action space that is neither a bounded `Box` nor `Discrete`.
    """

    def __init__(self, env: Any, seed: int = 0) -> None:
        self.seed = seed
        self.rows: NDArray[np.int64] | None = None
        self.action_space: gym.Space[Any] = getattr(env, "single_action_space", env.action_space)
        self.observation_space: gym.Space[Any] = getattr(env, "single_observation_space", env.observation_space)
        space = self.action_space
        if not isinstance(space, gym.spaces.Discrete) and not (
            isinstance(space, gym.spaces.Box) and space.is_bounded()
        ):
            raise ValueError(
                f"action_space must be a bounded Box or Discrete for the random agent, got {space}; "
                "wrap the environment"
            )

    def predict(
        self,
        observation: Any,
        state: int | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], int]:
        """Draw an action; `state` is the number of steps so far, which continues over episodes."""
        step = 0 if state is None else state
        batch = _batch_shape(observation, self.observation_space)
        draws = np.random.Generator(np.random.Philox(key=self.seed, counter=[0, 0, 0, step]))
        space = self.action_space
        # Draws come row by row, so that those of a row do not depend on the rows after it.
        drawn = batch if self.rows is None else (int(self.rows.max()) + 1,)
        chosen: Any = ... if self.rows is None else self.rows
        if isinstance(space, gym.spaces.Discrete):
            return (space.start + draws.integers(space.n, size=drawn)[chosen]).astype(space.dtype), step + 1
        assert isinstance(space, gym.spaces.Box)
        uniform = draws.random((*drawn, *space.shape))[chosen]
        return (space.low + uniform * (space.high - space.low)).astype(space.dtype), step + 1


def _batch_shape(observation: Any, space: gym.Space[Any]) -> tuple[int, ...]:
    """Return the leading axes of an observation beyond its space."""
    while isinstance(space, gym.spaces.Dict):
        key = next(iter(space.spaces))
        observation, space = observation[key], space[key]
    shape = np.shape(observation)
    return shape[: len(shape) - len(space.shape or ())]
