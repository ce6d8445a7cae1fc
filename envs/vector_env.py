"""Base class of the batched vector environments: seeds, resets by mask, the three autoreset modes, infos."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from servotrack.envs.arguments import check_options, check_render_mode, check_seed
from servotrack.envs.state import Resumable
from servotrack.envs.streams import episode_seed
from servotrack.estimators.types import Array, Labels, Mask

Observation = NDArray[Any] | dict[str, NDArray[Any]]


class BatchedWorld(Protocol):
    """Interface of the world of a `BatchedVectorEnv`: N scenes stepped together. Arrays have a leading axis of N."""

    steps: Labels
    reward: Array
    terminated: Mask
    truncated: Mask

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows are not changed."""

    def step(self, actions: Array, running: Mask | None = None) -> None:
        """Advance the rows whose episode is running. The other rows wait for their reset."""

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""

    def privileged(self) -> dict[str, Array]:
        """Return the entries that `VectorPrivilegedObservation` adds to observations."""


class FrameSource(Protocol):
    """Recorder of one row for its pictures."""

    def record(self) -> None:
        """Store the world's newest sample."""

    @property
    def frame(self) -> Callable[..., NDArray[np.uint8]]:
        """Function that draws the current state. Keywords are sensor data that the picture shows too."""


class BatchedVectorEnv(Resumable, gym.vector.VectorEnv[Any, Any, NDArray[Any]]):
    """A vector environment over a world that steps N scenes together.

    Args:
        world: World of N scenes.
        num_envs: Number of scenes N, a positive integer.
        action_space: Action space of one scene.
        observation_space: Observation space of one scene.
        metadata: Metadata of the environment.
        render_mode: None or `rgb_array`.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Largest number of steps of an episode, like the argument of `gym.make`.
    """

    config: Any
    world: Any
    _spec: EnvSpec | None = None

    def __init__(
        self,
        world: BatchedWorld,
        num_envs: int,
        action_space: gym.Space[Any],
        observation_space: gym.Space[Any],
        *,
        metadata: dict[str, Any],
        render_mode: str | None,
        autoreset_mode: AutoresetMode | str,
        max_episode_steps: int | None,
    ) -> None:
        self.num_envs = num_envs
        if render_mode == "human":
            raise ValueError("render_mode='human' shows one scene; use gym.make, or render_mode='rgb_array' here")
        self.render_mode = check_render_mode(render_mode)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = metadata | {"autoreset_mode": self.autoreset_mode}
        self._step_limit = _step_limit(max_episode_steps)
        self.world = world
        self.single_action_space, self.single_observation_space = action_space, observation_space
        self.action_space = batch_space(action_space, num_envs)
        self.observation_space = batch_space(observation_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._over = np.ones(num_envs, np.bool_)
        self._started = False
        self._recorders: list[FrameSource] = (
            [self._recorder(row) for row in range(num_envs)] if render_mode is not None else []
        )

    @abstractmethod
    def _observe(self) -> Any:
        """Return the observations of all scenes, as new arrays."""

    @abstractmethod
    def _checked(self, actions: Any) -> Array:
        """Return the actions as float64; raises a ValueError if their shape is wrong or they are not finite."""

    @abstractmethod
    def _infos(self, chosen: Mask) -> dict[str, Any]:
        """Return the infos of the chosen rows, in the layout of `masked_infos`."""

    @abstractmethod
    def _recorder(self, row: int) -> FrameSource:
        """Create the recorder of a row."""

    def _pictured(self, row: int) -> dict[str, Any]:
        """Sensor data of a row for its picture: keywords of `FrameSource.frame`."""
        return {}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated, without the argument `max_episode_steps`."""
        return int(self.world.episode_steps)

    @property  # type: ignore[override]
    def spec(self) -> EnvSpec | None:
        """Specification by Gymnasium; `max_episode_steps` is the truncation of this level with these keywords."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        limit = self.episode_steps if self._step_limit is None else min(self._step_limit, self.episode_steps)
        self._spec = spec_with_limit(spec, limit)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Random generators of the sub-environments."""
        self._generate([None] * self.num_envs)
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seeds of the sub-environments' generators."""
        self._generate([None] * self.num_envs)
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes, in all sub-environments or in those of a mask.

        Args:
            seed: An int s seeds sub-environment i with s + i. A sequence has one seed each; None keeps the generator.
            options: `reset_mask`, shape (N,) bool: mask of the sub-environments to reset. Not mutated.

        Returns:
            Observations of all sub-environments, and infos of those that were reset.

        Raises:
            ValueError: A seed list or mask of wrong length, an empty mask, or unknown options.
            TypeError: A mask that is not a boolean array.
        """
        seeds = self._seed_list(seed)
        chosen = self._reset_mask(options)
        if not self._started and not chosen.all():
            raise ResetNeeded("the first reset has to start all sub-environments: leave out options['reset_mask']")
        self._generate([s if m else None for s, m in zip(seeds, chosen.tolist(), strict=True)])
        self._restart(chosen)
        self._started = True
        observations = self._observe()
        self._record()
        return observations, self._infos(chosen)

    def step(self, actions: Any) -> tuple[Any, Array, Mask, Mask, dict[str, Any]]:
        """Advance all sub-environments by one step.

        Args:
            actions: One action for each sub-environment, with a leading axis of N.

        Returns:
            Observations, rewards, terminations, truncations, infos. The autoreset mode decides what follows the end
            of an episode.

        Raises:
            ValueError: The actions have a wrong shape or are not finite.
            gymnasium.error.ResetNeeded: Before the first reset. In mode DISABLED also after an episode's end, until its
                reset.
        """
        values = self._checked(actions)
        if not self._started:
            raise ResetNeeded("call reset() before the first step")
        waiting = self._over
        if self.autoreset_mode == AutoresetMode.DISABLED and waiting.any():
            raise ResetNeeded(
                f"sub-environments {np.flatnonzero(waiting).tolist()} have ended: reset them with "
                "options={'reset_mask': mask}, or use another autoreset_mode"
            )
        world = self.world
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and waiting.any():
            self._step_and_restart(values, waiting)
        else:
            world.step(values, ~waiting)
        terminated, truncated = world.terminated.copy(), world.truncated.copy()
        if self._step_limit is not None:
            truncated |= world.steps >= self._step_limit
        rewards = world.reward.copy()
        all_rows = np.ones(self.num_envs, np.bool_)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and waiting.any():
            rewards[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        ended = terminated | truncated
        self._over = ended
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            final_observations, final_infos = self._observe(), self._infos(ended)
            self._restart(ended)
            infos = self._infos(all_rows)
            infos |= self._final(ended, final_observations, final_infos)
        else:
            infos = self._infos(all_rows)
        observations = self._observe()
        self._record()
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """Draw all sub-environments: N new RGB frames, each (height, width, 3) uint8, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn(
                'render() draws nothing without a render mode; try gym.make_vec(id, render_mode="rgb_array")'
            )
            return None
        if not self._started:
            raise ResetNeeded("there is nothing to draw yet: call reset() before render()")
        return tuple(recorder.frame(**self._pictured(row)) for row, recorder in enumerate(self._recorders))

    def privileged(self) -> dict[str, Array]:
        """Entries that `VectorPrivilegedObservation` adds to observations, see the world's `privileged`."""
        return self.world.privileged()

    def _running_rows(self) -> Mask:
        return ~self._over

    def _row_generators(self) -> tuple[np.random.Generator, ...]:
        return self.np_random

    def _go_on(self, running: Mask, generators: list[np.random.Generator]) -> None:
        self._generate([None] * self.num_envs)
        self._generators, self._over = generators, ~running
        self._record()

    def _record(self) -> None:
        for recorder in self._recorders:
            recorder.record()

    def _restart(self, chosen: Mask) -> None:
        self.world.reset(*self._drawn_seeds(chosen))
        self._over = self._over & ~chosen

    def _step_and_restart(self, actions: Array, waiting: Mask) -> None:
        """Advance the running rows and start new episodes in the waiting ones."""
        self.world.step(actions, ~waiting)
        self._restart(waiting)

    def _drawn_seeds(self, chosen: Mask) -> tuple[list[int], list[int]]:
        """Return the indices of the chosen rows and the seeds of their next episodes."""
        rows = np.flatnonzero(chosen).tolist()
        return rows, [episode_seed(self._generators[row]) for row in rows]

    def _final(self, ended: Mask, observations: Any, infos: dict[str, Any]) -> dict[str, Any]:
        rows = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended).tolist():
            rows[row] = _row_of(observations, row)
        return {"final_obs": rows, "_final_obs": ended.copy(), "final_info": infos, "_final_info": ended.copy()}

    def _generate(self, seeds: Sequence[int | None]) -> None:
        """Create the generators that do not exist yet, and replace those that have a new seed."""
        fresh = not self._generators
        for row, seed in enumerate(seeds):
            if fresh or seed is not None:
                generator, used = seeding.np_random(seed)
                if fresh:
                    self._generators.append(generator)
                    self._seeds.append(used)
                else:
                    self._generators[row], self._seeds[row] = generator, used

    def _seed_list(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (list, tuple, np.ndarray)):
            first = check_seed(seed)
            assert first is not None
            return [first + row for row in range(self.num_envs)]
        seeds = [check_seed(s) for s in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed must be an int or a list of {self.num_envs}, one for each sub-environment, got {len(seeds)}"
            )
        return seeds

    def _reset_mask(self, options: dict[str, Any] | None) -> Mask:
        if options is None or "reset_mask" not in options:
            check_options(options)
            return np.ones(self.num_envs, np.bool_)
        check_options({key: value for key, value in options.items() if key != "reset_mask"})
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, got {mask!r}")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},), got {mask.shape}")
        if not mask.any():
            raise ValueError("options['reset_mask'] must be true for at least one sub-environment")
        return mask.copy()


def spec_with_limit(spec: EnvSpec | None, steps: int) -> EnvSpec | None:
    """Return a copy of a specification with the limit of steps that an environment itself keeps.

    The ids are registered without a limit, because it depends on level and keywords and `gym.make` would cut longer
    episodes at the registered one by its wrapper `TimeLimit`.
    """
    if spec is not None:
        spec = copy.copy(spec)
        spec.max_episode_steps = steps
    return spec


def copied(values: Array) -> Array:
    """Return a new array with a leading axis of N, for two float64 in a row in a third of the time of `values.copy()`.

    NumPy copies one element at a time where rows lie apart, as in a field of records: a pair is copied as one.
    """
    if values.ndim == 2 and values.dtype == np.float64 and values.shape[1] == 2 and values.strides[1] == 8:
        return values.view(np.complex128).copy().view(np.float64)
    return values.copy()


def masked_infos(values: dict[str, Any], chosen: Mask) -> dict[str, Any]:
    """Infos in the layout of Gymnasium's vector environments: a mask for every array, zeros where it is false.

    Args:
        values: Arrays with a leading axis of N, or dictionaries of them.
        chosen: Mask of the rows to include, shape (N,).

    Returns:
        Copies, with zeros in the other rows.
    """
    out: dict[str, Any] = {}
    whole = chosen.all()
    for key, value in values.items():
        if isinstance(value, dict):
            out[key] = masked_infos(value, chosen)
        elif whole:
            out[key] = copied(value)
        else:
            out[key] = np.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), value, np.zeros((), value.dtype))
        out[f"_{key}"] = chosen.copy()
    return out


def _row_of(observations: Any, row: int) -> Any:
    if isinstance(observations, dict):
        return {key: value[row].copy() for key, value in observations.items()}
    return observations[row].copy()


def _step_limit(max_episode_steps: int | None) -> int | None:
    if max_episode_steps is not None and max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be None or at least 1, got {max_episode_steps!r}")
    return max_episode_steps
