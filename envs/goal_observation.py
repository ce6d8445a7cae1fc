"""Wrapper that gives servo environments the form of goal-conditioned tasks, for hindsight experience replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.arguments import is_number
from servotrack.envs.box_scale import BoxScale
from servotrack.estimators.types import Array, FloatArray, Mask

GoalDict = dict[str, FloatArray]

REWARDS = ("sparse", "dense")
EPISODE_OVER = "episode_over"
"""Entry of `info`: the world ended the episode, at its horizon or because the target was lost."""


class GoalObservation(gym.Wrapper[Any, Any, Any, Any]):
    """Give a servo environment the contract of Gymnasium-Robotics' `GoalEnv`: move image points to desired places.

    The achieved goal is where the camera last saw the target's points, the desired goal where it has to see them. Both
    are measurements, so nothing is disclosed that an agent may not know; and the image of a target at rest follows
    from the arm's motion alone, so hindsight experience replay may replace the desired goal by a later achieved one.
    Use it with `UncalibServoReach-v0` and `UncalibServo3D-v0`, without `warmup`.

    | key | shape | meaning |
    |---|---|---|
    | `observation` | (k,) | all other entries, in alphabetical order of their keys, scaled to [-1, 1] by their bounds |
    | `achieved_goal` | (2p,) | newest image points of the target, in half widths of the image from its center |
    | `desired_goal` | (2p,) | desired image points, in the same unit |

    All are float32. With e the mean distance of the p points in px, the reward is -1 while e exceeds `threshold`, else
    0 (`sparse`), or -e divided by half the image's width (`dense`). It is a function of the two goals alone. Rewards
    are never positive, therefore an episode whose target was lost is truncated and not terminated: ending it early must
    not pay. `info` keeps the world's `success` and gains `episode_over`.

    Args:
        env: Environment with the observations `features` and `goal`.
        reward: `sparse` or `dense`.
        threshold: Error below which the sparse reward is 0, px. Larger values make the task easier.

    Raises:
        TypeError: The environment has no such observations.
        ValueError: An unknown reward, or a threshold that is not a positive number.
    """

    def __init__(self, env: gym.Env[Any, Any], reward: str = "sparse", threshold: float = 5.0) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Dict) or not {"features", "goal"} <= space.spaces.keys():
            raise TypeError(f"GoalObservation needs the observations features and goal, got {space}")
        if reward not in REWARDS:
            raise ValueError(f"reward must be one of {', '.join(REWARDS)}, got {reward!r}")
        if not is_number(threshold) or threshold <= 0.0:
            raise ValueError(f"threshold must be a positive number of px, got {threshold!r}")
        features, goal = space["features"], space["goal"]
        assert isinstance(features, gym.spaces.Box) and isinstance(goal, gym.spaces.Box)
        self.reward_type, self.threshold = reward, float(threshold)
        self._center, self._half_width = 0.5 * features.high, 0.5 * float(features.high[0])
        self._rest = {key: BoxScale(space[key], key) for key in sorted(space.spaces.keys() - {"features", "goal"})}
        size = sum(int(np.prod(scale.shape)) for scale in self._rest.values())
        goals = gym.spaces.Box(self._scaled(goal.low), self._scaled(goal.high), dtype=np.float32)
        self.observation_space = gym.spaces.Dict(
            {
                "observation": gym.spaces.Box(-1.0, 1.0, (size,), np.float32),
                "achieved_goal": goals,
                "desired_goal": goals,
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GoalDict, dict[str, Any]]:
        """Start a new episode, see the environment's `reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._goal_form(observation), {**info, EPISODE_OVER: False}

    def step(self, action: Any) -> tuple[GoalDict, Any, bool, bool, dict[str, Any]]:
        """Advance by one step, see the environment's `step`. `terminated` is always False."""
        observation, _, terminated, truncated, info = self.env.step(action)
        seen, info = self._goal_form(observation), {**info, EPISODE_OVER: terminated or truncated}
        goals = seen["achieved_goal"], seen["desired_goal"]
        return (
            seen,
            self.compute_reward(*goals, info),
            bool(self.compute_terminated(*goals, info)),
            bool(self.compute_truncated(*goals, info)),
            info,
        )

    def goal_error(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any]) -> Array:
        """Return the mean distance of the points from their desired places, px.

        Args:
            achieved_goal: Achieved goals, shape (..., 2p).
            desired_goal: Desired goals, the same shape.

        Returns:
            Errors, shape (...).
        """
        offsets = np.asarray(achieved_goal, dtype=np.float64) - np.asarray(desired_goal, dtype=np.float64)
        points = offsets.reshape(*offsets.shape[:-1], -1, 2)
        return self._half_width * np.hypot(points[..., 0], points[..., 1]).mean(axis=-1)

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Return the reward of goals.

        Args:
            achieved_goal: Achieved goals, shape (2p,) or (N, 2p).
            desired_goal: Desired goals, the same shape.
            info: Not read.

        Returns:
            A float, or an array of shape (N,).
        """
        error = self.goal_error(achieved_goal, desired_goal)
        reward = -error / self._half_width if self.reward_type == "dense" else -(error > self.threshold).astype(float)
        return reward if np.ndim(error) else float(reward)

    def compute_terminated(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> bool | Mask:
        """Return False, or an array of it for (N, 2p): reaching the goal does not end an episode."""
        rows = np.shape(achieved_goal)[:-1]
        return np.zeros(rows, np.bool_) if rows else False

    def compute_truncated(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> bool | Mask:
        """Return True where the world ended the episode.

        Args:
            achieved_goal: Achieved goals, shape (2p,) or (N, 2p). Only the shape is read.
            desired_goal: Not read.
            info: Info of one step; or for N steps a sequence of N infos, or one of arrays. False where it has no
                `episode_over`.

        Returns:
            A bool, or an array of shape (N,).
        """
        rows = np.shape(achieved_goal)[:-1]
        if not rows:
            return bool(info.get(EPISODE_OVER, False))
        over = (
            info.get(EPISODE_OVER, False) if isinstance(info, Mapping) else [i.get(EPISODE_OVER, False) for i in info]
        )
        return np.broadcast_to(np.asarray(over, np.bool_), rows).copy()

    def _goal_form(self, observation: Mapping[str, NDArray[Any]]) -> GoalDict:
        return {
            "observation": np.concatenate([scale.flat(observation[key]) for key, scale in self._rest.items()]),
            "achieved_goal": self._scaled(observation["features"]),
            "desired_goal": self._scaled(observation["goal"]),
        }

    def _scaled(self, points: NDArray[Any]) -> FloatArray:
        return ((points - self._center) / self._half_width).astype(np.float32)
