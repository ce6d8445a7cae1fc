"""Curriculum of rising difficulty: environments of several levels side by side, replaced stage by stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

Indices = Any


class Curriculum(VecEnv):
    """Vector environments that are replaced at the end of each stage; running episodes are truncated then.

    Args:
        make: Creates a vector environment from a level and a number of environments; all have the same spaces.
        stages: Levels of each stage of the training, one or more side by side.
        num_envs: Number of environments of a stage.
        stage_steps: Environment steps of each stage.
        first_seed: Returns the first seed of the environments of a stage, given the environment steps before it.
        done: Environment steps done before, in a resumed training.

    Raises:
        ValueError: No stage, an empty one, or more levels in a stage than environments.
    """

    def __init__(
        self,
        make: Callable[[Any, int], VecEnv],
        stages: Sequence[Sequence[Any]],
        num_envs: int,
        stage_steps: int,
        first_seed: Callable[[int], int],
        done: int = 0,
    ) -> None:
        if not stages or not all(0 < len(stage) <= num_envs for stage in stages):
            raise ValueError(f"curriculum must have stages of 1 to n_envs={num_envs} levels each, got {stages!r}")
        self.num_envs = num_envs
        self._make, self._stages, self._stage_steps = make, stages, stage_steps
        self._first_seed, self._done = first_seed, done
        self._begin()
        super().__init__(num_envs, self._parts[0].observation_space, self._parts[0].action_space)

    @property
    def stage(self) -> int:
        """Index of the present stage, from 0."""
        return min(self._done // self._stage_steps, len(self._stages) - 1)

    def _begin(self) -> None:
        """Create the environments of the stage."""
        self._begun = self.stage
        stages = self._stages[self._begun]
        sizes = [len(part) for part in np.array_split(np.arange(self.num_envs), len(stages))]
        self._ends = np.cumsum(sizes)
        self._parts = [self._make(level, size) for level, size in zip(stages, sizes, strict=True)]
        self.seed(self._first_seed(self._done))

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seeds of the environments for the next reset."""
        given: list[int | None] = []
        for part, end in zip(self._parts, self._ends.tolist(), strict=True):
            given.extend(part.seed(None if seed is None else seed + end - part.num_envs))
        return given

    def reset(self) -> NDArray[Any]:
        """Reset all rows."""
        return np.concatenate([part.reset() for part in self._parts])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Pass the actions to the environments."""
        for part, own in zip(self._parts, np.split(actions, self._ends[:-1]), strict=True):
            part.step_async(own)

    def step_wait(self) -> Any:
        """Step all rows. The end of a stage truncates all episodes."""
        stepped = [part.step_wait() for part in self._parts]
        observation, reward, done = (np.concatenate([step[i] for step in stepped]) for i in range(3))
        infos: list[dict[str, Any]] = [info for step in stepped for info in step[3]]
        self._done += self.num_envs
        if self.stage == self._begun:
            return observation, reward, done, infos
        for row in np.flatnonzero(~done).tolist():
            infos[row]["terminal_observation"] = observation[row]
            infos[row]["TimeLimit.truncated"] = True
        self.close()
        self._begin()
        return self.reset(), reward, np.ones_like(done), infos

    def close(self) -> None:
        """Close the environments."""
        for part in self._parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of every environment."""
        values = [value for part in self._parts for value in part.get_attr(attr_name)]
        return [values[row] for row in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of all environments."""
        for part in self._parts:
            part.set_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of all environments."""
        return [value for part in self._parts for value in part.env_method(method_name, *method_args, **method_kwargs)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Indices = None) -> list[bool]:
        """Return True for each environment that has a wrapper of the class."""
        return [value for part in self._parts for value in part.env_is_wrapped(wrapper_class)]
