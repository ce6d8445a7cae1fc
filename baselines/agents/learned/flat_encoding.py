"""Encodings of any bounded observation: its flattened entries, and the last few of such rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.contract import Encoding, PlainAnswers
from servotrack.estimators.types import FloatArray, Mask


@dataclass(frozen=True)
class FlatEncoding(PlainAnswers):
    """All entries of a Box, or of a Dict of Boxes in alphabetical order of its keys, scaled to [-1, 1] by the bounds.

    Attributes:
        low: Lower bounds, in the order of the row.
        high: Upper bounds.
        keys: Keys of a Dict, sorted; empty for a Box. Entries of an observation are found by them, so the order of keys
            in an observation has no effect.
        scaled: False leaves the entries in their physical units.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    keys: tuple[str, ...] = ()
    scaled: bool = True

    @classmethod
    def of(cls, space: spaces.Space[Any], scaled: bool = True) -> FlatEncoding:
        """Create the encoding of a space.

        Args:
            space: Observation space of one environment.
            scaled: False leaves the entries in their physical units.

        Raises:
            ValueError: A space that is not a bounded Box or a Dict of bounded Boxes.
        """
        keys = tuple(sorted(space.spaces)) if isinstance(space, spaces.Dict) else ()
        boxes = [space.spaces[key] for key in keys] if isinstance(space, spaces.Dict) else [space]
        for box in boxes:
            if not isinstance(box, spaces.Box) or not box.is_bounded():
                raise ValueError(f"observation_space must be a bounded Box, or a Dict of such, got {space}")
        low, high = (np.concatenate([np.ravel(getattr(box, side)) for box in boxes]) for side in ("low", "high"))
        return cls(tuple(low.tolist()), tuple(high.tolist()), keys, scaled)

    @property
    def size(self) -> int:
        """Length of a row."""
        return len(self.low)

    def initial(self, observation: Any) -> tuple[()]:
        """Return an empty memory."""
        return ()

    def step(self, memory: tuple[()], observation: Any, action: FloatArray) -> tuple[tuple[()], FloatArray]:
        """Process one observation; see `Encoding.step`."""
        parts = [observation[key] for key in self.keys] if self.keys else [observation]
        row = np.concatenate([np.asarray(part, np.float64).reshape(len(part), -1) for part in parts], axis=1)
        if not self.scaled:
            return (), row.astype(np.float32)
        low, high = np.array(self.low), np.array(self.high)
        return (), (2.0 * (row - low) / np.where(high > low, high - low, 1.0) - 1.0).astype(np.float32)


@dataclass(frozen=True)
class FlatAnswers:
    """An encoding whose network answers with the flattened entries of an action that has several axes, such as a set.

    Attributes:
        encoding: Encoding of the rows.
        shape: Shape of an action.
    """

    encoding: Encoding
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.encoding.size

    def initial(self, observation: Any) -> Any:
        """Return the memory before an episode; see `Encoding.initial`."""
        return self.encoding.initial(observation)

    def step(self, memory: Any, observation: Any, action: FloatArray) -> tuple[Any, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        return self.encoding.step(memory, observation, action)

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the flat Box of the action space."""
        return spaces.flatten_space(action_space)

    def act(self, memory: Any, answer: FloatArray) -> tuple[Any, NDArray[Any]]:
        """Return the answer in the shape of actions."""
        memory, action = self.encoding.act(memory, answer)
        return memory, action.reshape(len(action), *self.shape)


class StackMemory(NamedTuple):
    """Memory of `Stacked`.

    Attributes:
        own: Memory of the stacked encoding.
        rows: Last rows, the newest last. Shape (N, frames, size).
        fresh: True before the first row. Shape (N,).
    """

    own: Any
    rows: FloatArray
    fresh: Mask


@dataclass(frozen=True)
class Stacked:
    """Concatenates the last rows of another encoding, the newest last; at the start the first row is repeated.

    Attributes:
        encoding: Encoding of a single row.
        frames: Number of rows, at least 2.
    """

    encoding: Encoding
    frames: int

    def __post_init__(self) -> None:
        """Check the number of frames."""
        if self.frames < 2:
            raise ValueError(f"frames must be at least 2 to be stacked, got {self.frames!r}")

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.frames * self.encoding.size

    def initial(self, observation: Any) -> StackMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        count = len(next(iter(observation.values())) if isinstance(observation, Mapping) else observation)
        rows = np.zeros((count, self.frames, self.encoding.size), np.float32)
        return StackMemory(self.encoding.initial(observation), rows, np.ones(count, np.bool_))

    def step(self, memory: StackMemory, observation: Any, action: FloatArray) -> tuple[StackMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        rows = np.concatenate([memory.rows[:, 1:], row[:, None]], axis=1)
        if memory.fresh.any():
            rows = np.where(memory.fresh[:, None, None], row[:, None], rows)
        return StackMemory(own, rows, np.zeros_like(memory.fresh)), rows.reshape(len(rows), -1)

    def answer_space(self, action_space: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the network's answers; see `Encoding.answer_space`."""
        return self.encoding.answer_space(action_space)

    def act(self, memory: StackMemory, answer: FloatArray) -> tuple[StackMemory, NDArray[Any]]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        own, action = self.encoding.act(memory.own, answer)
        return memory._replace(own=own), action
