"""The vector environment under test: its creation and its test runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.testing.event_trace import ActionPlan, EventTrace, batch_actions, vector_traces, write_plan
from servotrack.estimators.testing.bits import first_difference

VectorEnv = gym.vector.VectorEnv[Any, Any, Any]
_REJECTIONS = (ValueError, TypeError, AssertionError, gym.error.Error)


class MakeVectorEnv(Protocol):
    """Callable that creates the environment under test."""

    def __call__(self, *, num_envs: int, autoreset_mode: AutoresetMode) -> VectorEnv:
        """Return a new vector environment."""


@dataclass(frozen=True)
class Subject:
    """The environment under test.

    Attributes:
        make: Creates the environment.
        num_envs: Number of sub-environments, at least 2.
        steps: Number of steps of every sub-environment in a check. Episodes must end within them.
        seed: First seed.
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
        """Create an environment and close it at the end. Typed Any, because Gymnasium's types lack lists of seeds."""
        env = self.make(num_envs=self.num_envs, autoreset_mode=mode)
        try:
            yield env
        finally:
            env.close()

    def plan(self, env: VectorEnv, interrupt_after: int | None = None) -> ActionPlan:
        """Plan of random actions that all checks share."""
        return write_plan(env.single_action_space, self.num_envs, self.seed, self.steps, interrupt_after)

    def traces(self, mode: AutoresetMode, tamper: bool = False, interrupt_after: int | None = None) -> list[EventTrace]:
        """Return the traces of a new environment."""
        with self.opened(mode) as env:
            return vector_traces(env, self.plan(env, interrupt_after), mode, tamper)

    def play(
        self, env: VectorEnv, mode: AutoresetMode, steps: int | None = None
    ) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Step through the plan and yield actions and results; in DISABLED, stop when an episode ends."""
        plan = self.plan(env)
        for step in range(self.steps if steps is None else steps):
            actions = batch_actions(env, [own[step] for own in plan.actions])
            result = env.step(actions)
            yield actions, result
            if mode == AutoresetMode.DISABLED and np.any(result[2] | result[3]):
                return


def assert_same(ours: Any, theirs: Any, rule: str) -> None:
    """Raise an AssertionError with the rule and the first difference, unless both are bit-identical."""
    found = first_difference(ours, theirs, "result")
    assert found is None, f"{rule}, but {found}"


def assert_rejected(what: str, call: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
    """Raise an AssertionError unless a call rejects its invalid input with a suitable error."""
    try:
        call(*args, **kwargs)
    except _REJECTIONS:
        return
    raise AssertionError(f"{what} must raise an error, but was accepted")
