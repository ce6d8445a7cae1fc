"""Contract between observations, a learned agent's network and the environment's actions."""

from __future__ import annotations

from typing import Any, Protocol

from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.estimators.types import FloatArray


class Encoding(Protocol):
    """Maps observations to rows for a network, and its answers to actions; memory is passed in and returned."""

    @property
    def size(self) -> int:
        """Length of a row."""

    def initial(self, observation: Any) -> Any:
        """Return the memory before an episode; `step` then gets the same first observation again."""

    def step(self, memory: Any, observation: Any, action: FloatArray) -> tuple[Any, FloatArray]:
        """Process one observation.

        Args:
            memory: Result of the last call, or of `initial`.
            observation: Observation of the environment, a batch.
            action: Action since the last observation, zeros at the first. Shape (N, actions).

        Returns:
            The new memory, and one row per environment, shape (N, size).
        """

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers for an action space of the environment."""

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """Convert the network's answer to actions.

        Args:
            memory: Result of `step`.
            answer: Answer of the network, shape (N, answers).

        Returns:
            The new memory, and actions with a leading axis of N, which may lie outside the bounds of their space.
        """


class PlainAnswers:
    """Mixin: the network's answers are the actions."""

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the action space; see `Encoding.answer_space`."""
        return action_space

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """Return the answer as action; see `Encoding.act`."""
        return memory, answer
