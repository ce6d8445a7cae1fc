"""Base classes of all tracking environments: sets as fixed arrays, checked actions, info, rendering."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from servotrack.envs.arguments import RENDER_MODES, check_count
from servotrack.envs.single_env import SingleEnv
from servotrack.envs.vector_env import BatchedVectorEnv, masked_infos
from servotrack.estimators.types import Array, Mask

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}


def set_space(rows: int, low: ArrayLike, high: ArrayLike) -> gym.spaces.Box:
    """Return the space of sets of at most `rows` members: existence from 0 to 1 in column 0, then the member.

    Unused rows are zeros; bounds that exclude zero are therefore widened to include it.

    Args:
        rows: Maximum number of members.
        low: Lowest member, shape (d,).
        high: Highest member, shape (d,).

    Returns:
        Box of shape (rows, 1 + d), float64.
    """
    lowest = np.minimum(np.concatenate([[0.0], np.asarray(low, dtype=np.float64)]), 0.0)
    highest = np.maximum(np.concatenate([[1.0], np.asarray(high, dtype=np.float64)]), 0.0)
    return gym.spaces.Box(np.tile(lowest, (rows, 1)), np.tile(highest, (rows, 1)), dtype=np.float64)


def check_answer(action: Any, shape: tuple[int, ...]) -> Array:
    """Return an action as a float64 array of the given shape.

    Raises:
        ValueError: If the action is not numeric, has another shape or contains NaN or infinity.
    """
    try:
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action must be numbers of shape {shape}, got {action!r}") from error
    if values.shape != shape:
        raise ValueError(
            f"action must have shape {shape}, that of the action space, got {values.shape}; fill unused rows of a "
            "set with zeros"
        )
    if not np.isfinite(values).all():
        raise ValueError("action must be finite, got NaN or infinity; fill unused rows of a set with zeros")
    return values


class TrackEnv(SingleEnv):
    """Tracking environment with one scene. Subclasses provide a batched world, the spaces and a recorder.

    The array `world.observations` holds the observations. The dictionaries returned by `world.truth()`,
    `world.scores()` and `world.episode_scores()` are the content of `info`. `render` draws the last observation and
    the answer to it.

    Args:
        world: Batched world with one row.
        observation_space: Space of a row of `world.observations`.
        action_space: Space of the estimated sets, made by `set_space`.
        render_mode: None, `rgb_array` or `human`.
        title: Title of the window.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def _observe(self) -> Array:
        return self.world.observations[0].copy()

    def _checked(self, action: Any) -> Array:
        assert self.action_space.shape is not None
        return check_answer(action, self.action_space.shape)

    def _info(self) -> dict[str, Any]:
        world = self.world
        info: dict[str, Any] = {"truth": {key: value[0].copy() for key, value in world.truth().items()}}
        if world.steps[0] > 0:
            info |= {key: value[0].item() for key, value in world.scores().items()}
        if world.truncated[0]:
            info |= {key: value[0].item() for key, value in world.episode_scores().items()}
        return info


class TrackVectorEnv(BatchedVectorEnv):
    """Tracking environment with N scenes. Subclasses provide a batched world, the spaces and the recorders.

    Args:
        world: Batched world with N rows.
        num_envs: Number of scenes N.
        observation_space: Observation space of one scene.
        action_space: Action space of one scene.
        render_mode: None or `rgb_array`.
        autoreset_mode: Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Maximum number of steps of an episode; None: the horizon of the world.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        world: Any,
        num_envs: int,
        observation_space: gym.Space[Any],
        action_space: gym.spaces.Box,
        render_mode: str | None,
        autoreset_mode: AutoresetMode | str,
        max_episode_steps: int | None,
    ) -> None:
        super().__init__(
            world,
            check_count(num_envs),
            action_space,
            observation_space,
            metadata=type(self).metadata,
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            max_episode_steps=max_episode_steps,
        )

    def _observe(self) -> Any:
        return self.world.observations.copy()

    def _checked(self, actions: Any) -> Array:
        assert self.action_space.shape is not None
        return check_answer(actions, self.action_space.shape)

    def _infos(self, chosen: Mask) -> dict[str, Any]:
        world = self.world
        infos = masked_infos({"truth": world.truth()}, chosen)
        answered, over = chosen & (world.steps > 0), chosen & world.truncated
        if answered.any():
            infos |= masked_infos(world.scores(), answered)
        if over.any():
            infos |= masked_infos(world.episode_scores(), over)
        return infos
