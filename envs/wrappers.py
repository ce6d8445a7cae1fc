"""Wrappers that belong to the worlds."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

Observation = dict[str, NDArray[Any]]

OBSERVATION_KEY = "observation"
"""Where an observation that is no dictionary is found beside the truth."""


def _widened(space: gym.Space[Any], extra: Observation) -> gym.spaces.Dict:
    """The observation space with one Box for each privileged array; the bounds are wide, but finite."""
    boxes = {key: gym.spaces.Box(-1e9, 1e9, value.shape, np.float64) for key, value in extra.items()}
    own = space.spaces if isinstance(space, gym.spaces.Dict) else {OBSERVATION_KEY: space}
    return gym.spaces.Dict({**own, **boxes})


def _joined(observation: Any, extra: Observation) -> Observation:
    own = observation if isinstance(observation, dict) else {OBSERVATION_KEY: observation}
    return {**own, **extra}


def _privileged(env: Any) -> Any:
    source = getattr(env.unwrapped, "privileged", None)
    if source is None:
        raise TypeError(f"{env.unwrapped!r} has no method `privileged()`: this world offers no truth to agents")
    return source


class PrivilegedObservation(gym.ObservationWrapper[Observation, Any, Observation]):
    """Add the truth to the observation, for oracles that declare `requires = {"truth"}`; the leaderboard marks them.

    Args:
        env: An environment with a method `privileged()` that returns a dictionary of float64 arrays.

    Raises:
        TypeError: The environment has no such method.
    """

    def __init__(self, env: gym.Env[Observation, Any]) -> None:
        super().__init__(env)
        self._privileged = _privileged(env)
        self.observation_space = _widened(env.observation_space, self._privileged())  # type: ignore[assignment]

    def observation(self, observation: Observation) -> Observation:
        """The observation and the truth beside it."""
        return _joined(observation, self._privileged())


class VectorPrivilegedObservation(gym.vector.VectorObservationWrapper):
    """`PrivilegedObservation` for a vector environment that offers `privileged()` with a leading axis of N.

    Args:
        env: Such a vector environment.

    Raises:
        TypeError: The environment has no such method.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._privileged = _privileged(env)
        rows = {key: value[0] for key, value in self._privileged().items()}
        self.single_observation_space = _widened(env.single_observation_space, rows)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: Observation) -> Observation:
        """The observations and the truth beside them."""
        return _joined(observations, self._privileged())
