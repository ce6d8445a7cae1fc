"""What goes into a learned agent's network, and what its answers do."""

from __future__ import annotations

from typing import Any, Protocol

from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.estimators.types import FloatArray


class Encoding(Protocol):
    """A value; all memory is handed around, with a leading axis of N as everywhere."""

    @property
    def size(self) -> int:
        """Numbers in a row."""

    def initial(self, observation: Any) -> Any:
        """Memory before an episode whose first observation this is; `step` takes the same one again."""

    def step(self, memory: Any, observation: Any, action: FloatArray) -> tuple[Any, FloatArray]:
        """Fold one observation in.

        Args:
            memory: What the last call returned, or `initial`.
            observation: A batch, as the environment gives it.
            action: What was done since the last observation, zeros at the first. Shape (N, actions).

        Returns:
            The new memory, and one row per environment, shape (N, size).
        """

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Box of what the network answers, where the environment takes actions of a space."""

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """What is done.

        Args:
            memory: What `step` returned.
            answer: Of the network, shape (N, answers).

        Returns:
            The new memory, and actions with a leading axis of N, which may lie beyond the bounds of their space.
        """


class PlainAnswers:
    """The network's answers are the actions."""

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """As `Encoding.answer_space`."""
        return action_space

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """As `Encoding.act`."""
        return memory, answer
