"""Base class of the single environments: seeds, episodes, rendering and truth over a batched world with one row."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import NDArray

from servotrack.envs.arguments import check_options, check_render_mode, check_seed
from servotrack.envs.state import Resumable
from servotrack.envs.streams import episode_seed
from servotrack.envs.vector_env import BatchedWorld, FrameSource, spec_with_limit
from servotrack.estimators.types import Array, Mask

if TYPE_CHECKING:
    from servotrack.envs.drawing.viewer import Viewer


class SingleEnv(Resumable, gym.Env[Any, Any]):
    """An environment with one scene of a batched world; `BatchedVectorEnv` has N.

    Args:
        world: World with one row.
        observation_space: Observation space.
        action_space: Action space.
        render_mode: None, `rgb_array` or `human`.
        title: Title of the window.
    """

    config: Any
    world: Any
    _spec: EnvSpec | None = None

    def __init__(
        self,
        world: BatchedWorld,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        render_mode: str | None,
        title: str,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.world = world
        self.observation_space = observation_space
        self.action_space = action_space
        self._running = self._started = False
        # OpenCV and pygame are imported only where something is drawn.
        self._recorder: FrameSource | None = None if render_mode is None else self._make_recorder()
        self._title = title
        self._viewer: Viewer | None = self._make_viewer()

    def _make_viewer(self) -> Viewer | None:
        if self.render_mode != "human":
            return None
        from servotrack.envs.drawing.viewer import Viewer

        return Viewer(self._title, self.metadata["render_fps"])

    @abstractmethod
    def _observe(self) -> Any:
        """Return the newest observation, as new arrays."""

    @abstractmethod
    def _checked(self, action: Any) -> Array:
        """Return the action as float64; raises a ValueError if its shape is wrong or it is not finite."""

    @abstractmethod
    def _info(self) -> dict[str, Any]:
        """Return the info of the newest sample."""

    @abstractmethod
    def _make_recorder(self) -> FrameSource:
        """Create the recorder of the past steps for pictures."""

    def _pictured(self) -> dict[str, Any]:
        """Sensor data for the picture: keywords of `FrameSource.frame`."""
        return {}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return int(self.world.episode_steps)

    @property  # type: ignore[override]
    def spec(self) -> EnvSpec | None:
        """Specification by Gymnasium; `max_episode_steps` is the truncation of this level with these keywords.

        `gym.make(env.spec)` makes the same environment. With other keywords use
        `gym.make(env.spec.id, **{**env.spec.kwargs, "horizon": 500})`: Gymnasium cuts what it makes from a
        specification at that specification's `max_episode_steps`.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec_with_limit(spec, self.episode_steps)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: Seed of this episode and, without further seeds, of all later ones.
            options: Must be None or empty; there are no options.

        Returns:
            Observation and info.

        Raises:
            ValueError: `options` is not empty, or `seed` is negative.
            TypeError: `seed` is not an integer.
        """
        check_options(options)
        seed = check_seed(seed)
        if seed is not None or self._np_random is None:
            self._np_random, self._np_random_seed = seeding.np_random(seed)
        self.world.reset([0], [episode_seed(self.np_random)])
        self._running = self._started = True
        observation = self._observe()
        self._show()
        return observation, self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        Args:
            action: Action, with the shape of the action space.

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ValueError: The action has a wrong shape or is not finite.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        values = self._checked(action)
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() before the first step and after an episode's end")
        world = self.world
        world.step(values[None])
        terminated, truncated = bool(world.terminated[0]), bool(world.truncated[0])
        self._running = not (terminated or truncated)
        observation = self._observe()
        self._show()
        return observation, float(world.reward[0]), terminated, truncated, self._info()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the current state.

        Returns:
            With `rgb_array`, a new RGB frame, shape (height, width, 3), uint8. With `human`, None: `reset` and `step`
            show the frames. Without a render mode, None.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        if self._recorder is None:
            gym.logger.warn('render() draws nothing without a render mode; try gym.make(id, render_mode="rgb_array")')
            return None
        if not self._started:
            raise ResetNeeded("there is nothing to draw yet: call reset() before render()")
        return self._recorder.frame(**self._pictured()) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()

    def _show(self) -> None:
        if self._recorder is not None:
            self._recorder.record()
        if self._recorder is not None and self._viewer is not None:
            self._viewer.show(self._recorder.frame(**self._pictured()))

    def privileged(self) -> dict[str, Array]:
        """Entries that `PrivilegedObservation` adds: those of the world's `privileged`, without the leading axis."""
        return {key: value[0] for key, value in self.world.privileged().items()}

    def _running_rows(self) -> Mask:
        return np.array([self._running])

    def _row_generators(self) -> list[np.random.Generator]:
        return [self.np_random]

    def _go_on(self, running: Mask, generators: list[np.random.Generator]) -> None:
        self._running, self._np_random = bool(running[0]), generators[0]
        if self._recorder is not None:
            self._recorder.record()

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy. A window cannot be copied: the copy opens its own."""
        return self.__dict__ | {"_viewer": None}

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        """Take over the attributes of the copied environment."""
        self.__dict__.update(attributes)
        self._viewer = self._make_viewer()
