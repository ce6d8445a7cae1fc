"""Base classes of all tracking environments: sets as fixed arrays, checked actions, info, rendering."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from servotrack.envs.arguments import RENDER_MODES, check_count, check_options, check_render_mode, check_seed
from servotrack.envs.streams import episode_seed
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


class TrackEnv(gym.Env[Any, Array]):
    """Tracking environment with one scene. Subclasses provide a batched world, the spaces and a recorder.

    The array `world.observations` holds the observations. The dictionaries returned by `world.truth()`,
    `world.scores()` and `world.episode_scores()` are the content of `info`.

    Args:
        world: Batched world with one row.
        observation_space: Space of a row of `world.observations`.
        action_space: Space of the estimated sets, made by `set_space`.
        render_mode: None, `rgb_array` or `human`.
        title: Title of the window.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    def __init__(
        self,
        world: Any,
        observation_space: gym.Space[Any],
        action_space: gym.spaces.Box,
        render_mode: str | None,
        title: str,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.world = world
        self.observation_space = observation_space
        # Gymnasium types Box without its dtype.
        self.action_space = action_space  # type: ignore[assignment]
        self._running = self._started = False
        self._recorder = self._make_recorder() if render_mode is not None else None
        self._viewer: Any = None
        if render_mode == "human":
            from servotrack.envs.drawing.viewer import Viewer

            self._viewer = Viewer(title, self.metadata["render_fps"])

    @abstractmethod
    def _make_recorder(self) -> Any:
        """Return the recorder that stores the past steps for pictures."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: Seed of this episode and, if later resets pass no seed, of all later ones.
            options: Must be None or empty.

        Returns:
            First observation, and info.

        Raises:
            ValueError: If `options` is not empty or the seed is negative.
            TypeError: If the seed is not an integer.
        """
        seed = check_seed(seed)
        if seed is not None or self._np_random is None:
            self._np_random, self._np_random_seed = seeding.np_random(seed)
        check_options(options)
        self.world.reset([0], [episode_seed(self.np_random)])
        self._running = self._started = True
        self._show()
        return self.world.observations[0].copy(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Answer the newest observation.

        Args:
            action: Estimated set, with the shape of the action space; a row is an identity.

        Returns:
            Next observation, reward, terminated, truncated, info.

        Raises:
            ValueError: If the action has another shape or is not finite.
            gymnasium.error.ResetNeeded: If no episode is running.
        """
        assert self.action_space.shape is not None
        values = check_answer(action, self.action_space.shape)
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() before the first step and after an episode's end")
        world = self.world
        world.step(values[None])
        terminated, truncated = bool(world.terminated[0]), bool(world.truncated[0])
        self._running = not (terminated or truncated)
        self._show()
        return world.observations[0].copy(), float(world.reward[0]), terminated, truncated, self._info()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the last answered observation with the answer; after a reset, draw the first observation.

        Returns:
            New RGB frame, uint8, with render mode `rgb_array`. None with `human`, because reset and step show the
            frames, and without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: If the environment was never reset.
        """
        if self._recorder is None:
            gym.logger.warn('render() draws nothing without a render mode; try gym.make(id, render_mode="rgb_array")')
            return None
        if not self._started:
            raise ResetNeeded("there is nothing to draw yet: call reset() before render()")
        return self._recorder.frame() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._viewer is not None:
            self._viewer.close()

    def _show(self) -> None:
        if self._recorder is not None:
            self._recorder.record()
        if self._recorder is not None and self._viewer is not None:
            self._viewer.show(self._recorder.frame())

    def _info(self) -> dict[str, Any]:
        world = self.world
        info: dict[str, Any] = {"truth": {key: value[0].copy() for key, value in world.truth().items()}}
        if world.steps[0] > 0:
            info |= {key: value[0].item() for key, value in world.scores().items()}
        if world.truncated[0]:
            info |= {key: value[0].item() for key, value in world.episode_scores().items()}
        return info

    def privileged(self) -> dict[str, Array]:
        """Return the entries that `PrivilegedObservation` adds: `world.privileged()` without the leading axis."""
        return {key: value[0] for key, value in self.world.privileged().items()}


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
