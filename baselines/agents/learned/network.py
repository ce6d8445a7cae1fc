"""Networks as ONNX files, run by onnxruntime: loading one runs no code of its author."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import onnxruntime

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest
from servotrack.estimators.types import FloatArray

LARGEST_NETWORK = 20_000_000
"""Largest accepted size of a network's file, bytes."""
OBSERVATION, MEMORY, ACTION, NEXT_MEMORY = "observation", "memory", "action", "next_memory"


def open_session(path: Path, card: LearnedCard) -> onnxruntime.InferenceSession:
    """Open a network's file for inference on one thread.

    Args:
        path: The ONNX file.
        card: Card of the network.

    Raises:
        AgentFileError: The file is missing, too large, different from the card's digest, not ONNX, or uses operators
            that onnxruntime does not support.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_NETWORK:
            raise AgentFileError(f"{path} has {size} bytes, a network at most {LARGEST_NETWORK}")
        content = path.read_bytes()
    except OSError as error:
        raise AgentFileError(f"{path} cannot be read ({error.strerror}); it belongs beside its card") from error
    if digest(content) != card.sha256:
        raise AgentFileError(f"{path} is not the file that its card describes: the card's sha256 is another one")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        # From memory: a file that refers to other files is refused.
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        reason = str(error).splitlines()[0]
        raise AgentFileError(f"{path} cannot be run by onnxruntime: {reason}") from error


class OnnxNetwork:
    """A policy network: rows of observations and memory in, actions and the next memory out.

    Args:
        path: The ONNX file. Inputs `observation` (N, size) and, if it is recurrent, `memory` (N, M); outputs `action`
            (N, actions) and `next_memory` (N, M); all float32, N free.
        card: Card of the network.

    Raises:
        AgentFileError: An invalid file (see `open_session`), or one with other inputs or outputs.
    """

    def __init__(self, path: Path, card: LearnedCard) -> None:
        self.path = path
        self._session = open_session(path, card)
        self.size = self._width(self._session.get_inputs(), OBSERVATION)
        self.actions = self._width(self._session.get_outputs(), ACTION)
        self.memory = card.memory
        names = [value.name for value in self._session.get_inputs()]
        if names != [OBSERVATION, *([MEMORY] if self.memory else [])]:
            raise AgentFileError(f"{path} must have the inputs observation and, if it remembers, memory, got {names}")
        if self.memory:
            widths = (
                self._width(self._session.get_inputs(), MEMORY),
                self._width(self._session.get_outputs(), NEXT_MEMORY),
            )
            if widths != (self.memory, self.memory):
                raise AgentFileError(f"{path} carries {widths} numbers of memory, its card says {self.memory}")
        self._outputs = [ACTION, *([NEXT_MEMORY] if self.memory else [])]

    def __call__(self, rows: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Run the network.

        Args:
            rows: Inputs, shape (N, size).
            memory: Memory of the last call, shape (N, M); M is 0 for a network without memory.

        Returns:
            Actions, shape (N, actions), and the next memory.
        """
        if not self.memory:
            return self._session.run(self._outputs, {OBSERVATION: rows})[0], memory
        action, following = self._session.run(self._outputs, {OBSERVATION: rows, MEMORY: memory})
        return action, following

    def _width(self, values: list[Any], name: str) -> int:
        """Return the second dimension of an input or output."""
        found = next((value for value in values if value.name == name), None)
        if found is None:
            raise AgentFileError(f"{self.path} must have {name!r}, got {[value.name for value in values]}")
        if found.type != "tensor(float)" or len(found.shape) != 2 or not isinstance(found.shape[1], int):
            raise AgentFileError(
                f"{self.path}: {name} must be float32 of shape (N, known), got {found.type} {found.shape}"
            )
        return int(found.shape[1])
