"""A Stable-Baselines3 vector environment whose observations are encoded as in the exported agent."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import FloatArray

Memory = TypeVar("Memory")


class EncodedVecEnv(VecEnvWrapper):
    """Replaces observations by rows of an encoding; actions are clipped as in the exported agent.

    Args:
        venv: The environments.
        encoding: Encoding of the observations.
    """

    def __init__(self, venv: VecEnv, encoding: Encoding) -> None:
        bounds: Any = venv.action_space
        rows = spaces.Box(-np.inf, np.inf, (encoding.size,), np.float32)
        super().__init__(venv, rows, encoding.answer_space(bounds))
        self.encoding = encoding
        self._memory: Any = None
        self._bounds = bounds
        self._action = np.zeros((venv.num_envs, *self._bounds.shape), self._bounds.dtype)

    def reset(self) -> FloatArray:
        """Reset all rows."""
        observation: Any = self.venv.reset()
        self._memory, rows = self.encoding.step(
            self.encoding.initial(observation), observation, np.zeros_like(self._action)
        )
        return rows

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions until `step_wait`."""
        self._memory, action = self.encoding.act(self._memory, actions)
        self._action = np.clip(action, self._bounds.low, self._bounds.high).astype(self._bounds.dtype)
        self.venv.step_async(self._action)

    def step_wait(self) -> Any:
        """Step all rows; terminal observations are encoded, too."""
        observation: Any
        observation, reward, done, infos = self.venv.step_wait()
        memory, action = self._memory, self._action
        if done.any():
            ended = np.flatnonzero(done)
            last = _stacked([infos[row]["terminal_observation"] for row in ended])
            _, rows = self.encoding.step(_rows(memory, ended), last, action[ended])
            for row, final in zip(ended, rows, strict=True):
                infos[row]["terminal_observation"] = final
            memory = select_rows(done, self.encoding.initial(observation), memory)
            action = action.copy()
            action[done] = 0.0
        self._memory, rows = self.encoding.step(memory, observation, action)
        return rows, reward, done, infos


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)


def _rows(memory: Memory, rows: NDArray[np.intp]) -> Memory:
    """Select rows of an array, or of nested tuples of arrays."""
    if isinstance(memory, tuple):
        parts = [_rows(part, rows) for part in memory]
        return type(memory)(*parts) if hasattr(memory, "_fields") else type(memory)(parts)  # type: ignore[return-value]
    return memory[rows]  # type: ignore[index, no-any-return]
