"""Recording: an agent of this package acts in a cell, and its actions are rounded to the grid before they count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.replay import Episode
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.estimators.types import Mask


class Player(Protocol):
    """Something that acts in a cell: an agent of this package, or a program."""

    def play(self, suite: Suite, cell: SuiteCell, seeds: Sequence[int]) -> list[Episode]:
        """Act in one episode per seed and return its actions."""


class AgentPlayer:
    """An agent with `predict`. All episodes of a call run side by side.

    Args:
        card: Card of the agent.
    """

    def __init__(self, card: AgentCard) -> None:
        self.card = card

    def play(self, suite: Suite, cell: SuiteCell, seeds: Sequence[int]) -> list[Episode]:
        """Act in one episode per seed and return its actions; see `Player`.

        Raises:
            ValueError: An agent that does not fit the cell, or an action that is not finite.
        """
        env = make_vector(cell.env_id, len(seeds), cell.env_kwargs, privileged=self.card.privileged)
        try:
            grid = ActionGrid.of(env.single_action_space, suite.grid)
            agent = create_agent(self.card, env)
            observation, _ = env.reset(seed=list(seeds))
            state: Any = None
            starts: Mask = np.ones(len(seeds), dtype=bool)
            ended: Mask = np.zeros(len(seeds), dtype=bool)
            running = np.ones(len(seeds), dtype=bool)
            points: list[NDArray[np.int16]] = []
            lengths = np.zeros(len(seeds), dtype=np.int64)
            while running.any():
                action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
                points.append(grid.rounded(action))
                lengths += running
                observation, _, terminated, truncated, _ = env.step(grid.actions(points[-1]))
                # The step after an end only resets: its observation starts the next episode, which does not count.
                starts, ended = ended, terminated | truncated
                running &= ~ended
        finally:
            env.close()
        steps = np.stack(points, axis=1)
        return [Episode(seed, steps[k, : lengths[k]].copy()) for k, seed in enumerate(seeds)]
