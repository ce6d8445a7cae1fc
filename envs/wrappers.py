"""Wrappers that add the ground truth to observations."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

Observation = dict[str, NDArray[Any]]

OBSERVATION_KEY = "observation"
"""Key of an observation that is not a dictionary, next to the entries of the truth."""
NOISE_KEY = "noise"
"""Key of the covariances of the measurements' noise, in the observations of worlds whose sensors report them."""
INTERVAL_KEY = "interval"
"""Key of the time between the last two scans, s, in the observations of worlds whose intervals vary."""


def _widened(space: gym.Space[Any], extra: Observation) -> gym.spaces.Dict:
    """Observation space with one Box for each privileged array. Bounds are wide, but finite."""
    boxes = {key: gym.spaces.Box(-1e9, 1e9, value.shape, np.float64) for key, value in extra.items()}
    own = space.spaces if isinstance(space, gym.spaces.Dict) else {OBSERVATION_KEY: space}
    return gym.spaces.Dict({**own, **boxes})


def _joined(observation: Any, extra: Observation) -> Observation:
    own = observation if isinstance(observation, dict) else {OBSERVATION_KEY: observation}
    return {**own, **extra}


def _privileged(env: Any) -> Any:
    source = getattr(env.unwrapped, "privileged", None)
    if source is None:
        raise TypeError(f"{env.unwrapped!r} has no method `privileged()`: it has no ground truth for agents")
    return source


class PrivilegedObservation(gym.ObservationWrapper[Observation, Any, Observation]):
    """Add the ground truth to the observation, for oracles with `requires = {"truth"}`. The leaderboard marks them.

    Args:
        env: Environment with a method `privileged()` that returns a dictionary of float64 arrays.

    Raises:
        TypeError: The environment has no such method.
    """

    def __init__(self, env: gym.Env[Observation, Any]) -> None:
        super().__init__(env)
        self._privileged = _privileged(env)
        self.observation_space = _widened(env.observation_space, self._privileged())  # type: ignore[assignment]

    def observation(self, observation: Observation) -> Observation:
        """Return the observation with the truth added."""
        return _joined(observation, self._privileged())


class VectorPrivilegedObservation(gym.vector.VectorObservationWrapper):
    """`PrivilegedObservation` for vector environments.

    Args:
        env: Vector environment with a method `privileged()` whose arrays have a leading axis of N.

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
        """Return the observations with the truth added."""
        return _joined(observations, self._privileged())
