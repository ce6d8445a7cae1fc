"""The vector environment under test: how to make it, and what to do with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.testing.bits import first_difference
from servotrack.envs.testing.event_trace import ActionPlan, EventTrace, batch_actions, vector_traces, write_plan

VectorEnv = gym.vector.VectorEnv[Any, Any, Any]
_REFUSALS = (ValueError, TypeError, AssertionError, gym.error.Error)


class MakeVectorEnv(Protocol):
    """What makes the environment under test."""

    def __call__(self, *, num_envs: int, autoreset_mode: AutoresetMode) -> VectorEnv:
        """A new vector environment."""


@dataclass(frozen=True)
class Subject:
    """The environment under test.

    Attributes:
        make: Makes it.
        num_envs: Number of sub-environments, at least 2.
        steps: Steps of every sub-environment in a check; episodes have to end within.
        seed: First of the seeds.
        modes: Autoreset modes to check.
    """

    make: MakeVectorEnv
    num_envs: int
    steps: int
    seed: int
    modes: tuple[AutoresetMode, ...]

    @property
    def seeds(self) -> list[int]:
        """One seed for each sub-environment."""
        return [self.seed + row for row in range(self.num_envs)]

    @contextmanager
    def opened(self, mode: AutoresetMode) -> Iterator[Any]:
        """A new environment, closed at the end; typed Any, for Gymnasium's annotations know no lists of seeds."""
        env = self.make(num_envs=self.num_envs, autoreset_mode=mode)
        try:
            yield env
        finally:
            env.close()

    def script(self, env: VectorEnv, interrupt_after: int | None = None) -> ActionPlan:
        """The script of random actions that all checks share."""
        return write_plan(env.single_action_space, self.num_envs, self.seed, self.steps, interrupt_after)

    def stories(
        self, mode: AutoresetMode, tamper: bool = False, interrupt_after: int | None = None
    ) -> list[EventTrace]:
        """The stories of a new environment."""
        with self.opened(mode) as env:
            return vector_traces(env, self.script(env, interrupt_after), mode, tamper)

    def play(
        self, env: VectorEnv, mode: AutoresetMode, steps: int | None = None
    ) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Step on, yielding the actions and what came back; in DISABLED until an episode ends."""
        script = self.script(env)
        for step in range(self.steps if steps is None else steps):
            actions = batch_actions(env, [own[step] for own in script.actions])
            result = env.step(actions)
            yield actions, result
            if mode == AutoresetMode.DISABLED and np.any(result[2] | result[3]):
                return


def assert_same(ours: Any, theirs: Any, rule: str) -> None:
    """Raises AssertionError that states the rule and the first difference, unless every bit is the same."""
    found = first_difference(ours, theirs, "result")
    assert found is None, f"{rule}, but {found}"


def assert_refused(what: str, call: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
    """Raises AssertionError unless a call raises one of the errors that bad input deserves."""
    try:
        call(*args, **kwargs)
    except _REFUSALS:
        return
    raise AssertionError(f"{what} must raise an error that names it; it was accepted")
