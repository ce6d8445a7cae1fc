"""Wrappers that give reinforcement learning libraries vectors in [-1, 1] and images that their networks accept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from servotrack.envs.box_scale import BoxScale
from servotrack.estimators.types import FloatArray

MIN_IMAGE_SIZE = 36
"""Least height and width of an image, px. Below it the convolutions of Stable-Baselines3's `NatureCNN` do not fit."""


class _View(Protocol):
    """Map of observations from one space to another."""

    @property
    def space(self) -> gym.Space[Any]:
        """Space of the mapped observations."""

    def flat(self, values: Any) -> Any:
        """Map an observation, or a batch of them."""


class _Image:
    """An RGB image, enlarged by repeating each pixel until both sides reach `MIN_IMAGE_SIZE`."""

    def __init__(self, space: gym.spaces.Box) -> None:
        height, width, channels = space.shape
        self._factor = -(-MIN_IMAGE_SIZE // min(height, width))
        self.space = gym.spaces.Box(0, 255, (height * self._factor, width * self._factor, channels), np.uint8)

    def flat(self, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._factor == 1:
            return values
        return values.repeat(self._factor, axis=-3).repeat(self._factor, axis=-2)


class _Entries:
    """The entries of a Dict, each mapped by its own view."""

    def __init__(self, space: gym.spaces.Dict) -> None:
        self._views = {key: _view(part, f"observation {key!r}") for key, part in space.spaces.items()}
        self.space = gym.spaces.Dict({key: view.space for key, view in self._views.items()})

    def flat(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: view.flat(values[key]) for key, view in self._views.items()}


def _view(space: gym.Space[Any], name: str) -> _View:
    if isinstance(space, gym.spaces.Dict):
        return _Entries(space)
    if isinstance(space, gym.spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3:
        return _Image(space)
    return BoxScale(space, name)


class FlatSets(gym.Wrapper[Any, Any, Any, Any]):
    """Give libraries what their networks expect: float32 vectors in [-1, 1], and images of at least 36 x 36 pixels.

    Sets, tables and vectors become flat rows whose entries are rescaled by their bounds, and so does the action. The
    zeros of an unused row of a set map to values inside (-1, 1) according to the bounds, and its existence to -1. An
    image stays a uint8 image; a smaller one, such as the 32 x 32 patch of `PedestrianServo-v0`, is enlarged by
    repeating its pixels. A Dict stays a Dict. Stable-Baselines3's `check_env` passes on every id of this package
    without a warning, and its `MlpPolicy`, `CnnPolicy` or `MultiInputPolicy` learns from it.

    Args:
        env: Environment whose action space is a bounded Box and whose observation space is one or a Dict of such.

    Raises:
        TypeError: A space is not bounded.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._seen, self._done = _view(env.observation_space, "observation"), BoxScale(env.action_space, "action")
        self.observation_space, self.action_space = self._seen.space, self._done.space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and flatten the observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._seen.flat(observation), info

    def step(self, action: NDArray[Any]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step with a flat action in [-1, 1] (clipped) and flatten the observation."""
        observation, reward, terminated, truncated, info = self.env.step(self._done.restored(action))
        return self._seen.flat(observation), reward, terminated, truncated, info


class VectorFlatSets(gym.vector.VectorWrapper):
    """`FlatSets` for a vector environment.

    Args:
        env: Vector environment whose single action space is a bounded Box, and whose single observation space is one
            or a Dict of such.

    Raises:
        TypeError: A space is not bounded.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._seen = _view(env.single_observation_space, "observation")
        self._done = BoxScale(env.single_action_space, "action")
        self.single_observation_space, self.single_action_space = self._seen.space, self._done.space
        self.observation_space = batch_space(self._seen.space, env.num_envs)
        self.action_space = batch_space(self._done.space, env.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environments and flatten the observations."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._seen.flat(observations), infos

    def step(self, actions: FloatArray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step with flat actions in [-1, 1] (clipped) and flatten the observations, also those in `final_obs`."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._done.restored(actions))
        if "final_obs" in infos:
            final = np.full(len(infos["final_obs"]), None, dtype=object)
            for row in np.flatnonzero(infos["_final_obs"]):
                final[row] = self._seen.flat(infos["final_obs"][row])
            infos = {**infos, "final_obs": final}
        return self._seen.flat(observations), rewards, terminated, truncated, infos
