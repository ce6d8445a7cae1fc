"""Base classes of all tracking environments: sets as fixed arrays, checked actions, info, rendering."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from servotrack.envs.arguments import available_render_modes, check_count
from servotrack.envs.single_env import SingleEnv
from servotrack.envs.vector_env import BatchedVectorEnv, masked_infos
from servotrack.estimators.types import Array, Mask

METADATA: dict[str, Any] = {"render_modes": available_render_modes(), "render_fps": 10}


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


def all_infos(world: Any) -> dict[str, Any]:
    """Info of all rows: arrays, or dictionaries of arrays, with a leading axis of N.

    Every info has the same keys, as recorders of episodes need it: scores of the last answer are 0 before the first
    one, and scores of the episode are 0 until `episode_scored`, when the whole episode was answered.
    """
    scores, whole = _from_then_on(world.scores(), world.steps > 0), world.episode_scores()
    if whole:
        scores |= {"episode_scored": world.truncated, **_from_then_on(whole, world.truncated)}
    return {"truth": world.truth(), **scores}


def _from_then_on(values: dict[str, Array], known: Mask) -> dict[str, Array]:
    return {key: np.where(known, value, np.zeros((), value.dtype)) for key, value in values.items()}


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
        return {
            key: {name: part[0].copy() for name, part in value.items()} if key == "truth" else value[0].item()
            for key, value in all_infos(self.world).items()
        }


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
        return masked_infos(all_infos(self.world), chosen)
