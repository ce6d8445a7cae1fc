"""Wrappers that flatten sets to vectors in [-1, 1], as reinforcement learning libraries expect."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from servotrack.estimators.types import Array, FloatArray


class _Scale:
    """Map between a finite Box of any shape and the flat Box [-1, 1] of float32."""

    def __init__(self, space: gym.Space[Any], name: str) -> None:
        if not isinstance(space, gym.spaces.Box) or not space.is_bounded() or not (space.high > space.low).all():
            raise TypeError(f"FlatSets needs a Box with finite bounds as {name} space, got {space}")
        self.shape = space.shape
        self._low, self._span = space.low.astype(np.float64), space.high.astype(np.float64) - space.low
        self.space = gym.spaces.Box(-1.0, 1.0, (int(np.prod(space.shape)),), np.float32)

    def flat(self, values: NDArray[Any]) -> FloatArray:
        scaled = 2.0 * (values - self._low) / self._span - 1.0
        batch = values.shape[: values.ndim - len(self.shape)]
        return scaled.reshape(*batch, -1).astype(np.float32)

    def restored(self, values: NDArray[Any]) -> Array:
        flat = np.clip(np.asarray(values, dtype=np.float64), -1.0, 1.0)
        return self._low + 0.5 * (flat.reshape(*flat.shape[:-1], *self.shape) + 1.0) * self._span


class FlatSets(gym.Wrapper[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]):
    """Flatten observation and action of a tracking environment to float32 vectors, every entry rescaled to [-1, 1].

    The zeros of an unused row map to values inside (-1, 1) according to the bounds, and its existence to -1.

    Args:
        env: Environment whose observation and action spaces are bounded boxes.

    Raises:
        TypeError: A space is not a bounded box.
    """

    def __init__(self, env: gym.Env[NDArray[Any], NDArray[Any]]) -> None:
        super().__init__(env)
        self._seen, self._done = _Scale(env.observation_space, "observation"), _Scale(env.action_space, "action")
        self.observation_space, self.action_space = self._seen.space, self._done.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Reset the environment and flatten the observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._seen.flat(observation), info

    def step(self, action: NDArray[Any]) -> tuple[FloatArray, Any, bool, bool, dict[str, Any]]:
        """Step with a flat action in [-1, 1] (clipped) and flatten the observation."""
        observation, reward, terminated, truncated, info = self.env.step(self._done.restored(action))
        return self._seen.flat(observation), reward, terminated, truncated, info


class VectorFlatSets(gym.vector.VectorWrapper):
    """`FlatSets` for a vector environment.

    Args:
        env: Vector environment whose single observation and action spaces are bounded boxes.

    Raises:
        TypeError: A space is not a bounded box.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._seen = _Scale(env.single_observation_space, "observation")
        self._done = _Scale(env.single_action_space, "action")
        self.single_observation_space, self.single_action_space = self._seen.space, self._done.space
        self.observation_space = batch_space(self._seen.space, env.num_envs)
        self.action_space = batch_space(self._done.space, env.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
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
