"""Delay an agent's answers: in a world with a lag, the answer to scan k is for scan k - lag."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.protocol import Agent
from servotrack.estimators.types import Array, Mask


class DelayedState(NamedTuple):
    """Memory of a `DelayedAgent`.

    Attributes:
        memory: Memory of the agent.
        waiting: Answers that are not due yet, the oldest first. Shape (lag, rows, d), or (N, lag, rows, d).
    """

    memory: Any
    waiting: Array


class DelayedAgent:
    """An agent without a smoother in a world whose answers are delayed; its first `lag` answers are empty sets.

    Args:
        agent: Agent that answers every scan at once, with sets.
        lag: Number of scans by which the answers are delayed, at least 1.
    """

    def __init__(self, agent: Agent, lag: int) -> None:
        self._agent, self._lag = agent, lag

    def predict(
        self,
        observation: Any,
        state: DelayedState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, DelayedState]:
        """Return the agent's answer to the observation `lag` scans ago; arguments as those of the agent."""
        before = None if state is None else state.memory
        now, memory = self._agent.predict(observation, before, episode_start, deterministic)
        *batch, rows, size = now.shape
        waiting = np.zeros((*batch, self._lag, rows, size)) if state is None else state.waiting
        if episode_start is not None:
            start = np.broadcast_to(np.asarray(episode_start, np.bool_), batch)
            waiting = np.where(start[..., None, None, None], 0.0, waiting)
        later = np.concatenate([waiting[..., 1:, :, :], now[..., None, :, :]], axis=-3)
        return waiting[..., 0, :, :].copy(), DelayedState(memory, later)
