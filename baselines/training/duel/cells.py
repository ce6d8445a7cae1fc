"""Cells of the duel: a world at a level, test seeds inside its ranges, and test seeds beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import gymnasium as gym

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.episodes import full_episode_steps
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.worlds import World, describe_environment, world_of_id
from servotrack.envs.servo.widening import widened_axes

FIRST_TEST_SEED = 500_000
"""Offset in the test range, far from the seeds on which agents were compared while they were made."""
TEST_EPISODES, HELD_OUT_EPISODES = 200, 100
WIDENING = 0.25
"""Share by which held-out ranges are wider than those of the cell."""

_KEPT = ("return", "length", "success")
"""Columns of results that are kept in every world, beside its metrics."""

Columns = dict[str, list[float]]
"""Numbers of episodes by column of results, in the order of the seeds."""


@dataclass(frozen=True)
class Cell:
    """A world at a level.

    Attributes:
        env_id: Gymnasium id.
        level: Level of the world.
    """

    env_id: str
    level: int

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {"level": self.level}

    @property
    def title(self) -> str:
        """Id and level in one line."""
        return describe_environment(self.env_id, self.env_kwargs)

    @property
    def world(self) -> World:
        """Record of the kind of world."""
        return world_of_id(self.env_id)

    @property
    def episode_steps(self) -> int:
        """Steps of a full episode."""
        return _episode_steps(self.env_id, self.level)

    @property
    def held_out_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment with ranges wider by `WIDENING`; see `widened_axes`."""
        env = gym.make_vec(self.env_id, num_envs=1, vectorization_mode="vector_entry_point", **self.env_kwargs)
        try:
            return {**self.env_kwargs, **widened_axes(env.unwrapped.config, WIDENING)}  # type: ignore[attr-defined]
        finally:
            env.close()

    def test(self, agent: AgentCard) -> Columns:
        """Run an agent on the test seeds."""
        return self._columns(agent, TEST_EPISODES, self.env_kwargs)

    def test_held_out(self, agent: AgentCard) -> Columns:
        """Run an agent on the first test seeds in wider ranges."""
        return self._columns(agent, HELD_OUT_EPISODES, self.held_out_kwargs)

    def _columns(self, agent: AgentCard, count: int, env_kwargs: dict[str, Any]) -> Columns:
        rows, _ = run_episodes(self.env_id, agent, test_seeds(count), env_kwargs)
        names = dict.fromkeys((*_KEPT, *(metric.column for metric in self.world.shown)))
        return {name: [_short(row[name]) for row in rows] for name in names}


def test_seeds(count: int) -> Sequence[int]:
    """Return the first seeds on which all methods are tested."""
    return seed_ranges.take("test", count, FIRST_TEST_SEED)


@lru_cache
def _episode_steps(env_id: str, level: int) -> int:
    env = gym.make_vec(env_id, num_envs=1, vectorization_mode="vector_entry_point", level=level)
    try:
        steps = full_episode_steps(env)
    finally:
        env.close()
    if steps is None:
        raise ValueError(f"{env_id} must have a limit of steps to take part; register it with max_episode_steps")
    return steps


def _short(value: float) -> float:
    """Round to five digits: rows are committed."""
    return int(value) if isinstance(value, (bool, int)) else float(f"{value:.5g}")
