"""Networks as ONNX files of unknown origin: checked before onnxruntime runs them, and watched while it does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest
from servotrack.baselines.agents.learned.onnx_file.check import CheckedNetwork, Row, check_network
from servotrack.baselines.agents.learned.onnx_file.reader import FLOAT, TYPES
from servotrack.baselines.reporting.files import ResultsError, read_bounded
from servotrack.estimators.types import FloatArray

LARGEST_NETWORK = 20_000_000
"""Largest accepted size of a network's file, bytes."""
LARGEST_BATCH_MEMORY = 4_000_000_000
"""Largest memory of the intermediate tensors of a batch, bytes."""
OBSERVATION, MEMORY, ACTION, NEXT_MEMORY = "observation", "memory", "action", "next_memory"


class NetworkSession:
    """A checked network in onnxruntime, on one thread.

    A regular file is read, without following a link, and passed to onnxruntime from memory. It must hold its weights
    itself and consist of allowed operators with known shapes and bounded cost; see
    `servotrack.baselines.agents.learned.onnx_file.check`.

    Args:
        path: The ONNX file.
        card: Card of the network.

    Raises:
        AgentFileError: The file is missing, too large, different from the card's digest, not ONNX, holds something that
            is not allowed, or cannot be run by onnxruntime.
    """

    def __init__(self, path: Path, card: LearnedCard) -> None:
        try:
            content = read_bounded(path, LARGEST_NETWORK, follow=False)
        except ResultsError as error:
            raise AgentFileError(f"{error}; a network belongs beside its card") from error
        if digest(content) != card.sha256:
            raise AgentFileError(f"{path} is not the file that its card describes: the card's sha256 is another one")
        try:
            self.form: CheckedNetwork = check_network(content)
        except ValueError as error:
            raise AgentFileError(f"{path} is not a network that may run: {error}") from error
        self.path = path
        self._session = self._create(content)

    def _create(self, content: bytes) -> onnxruntime.InferenceSession:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        # Otherwise onnxruntime guesses from the bytes, and may read an unchecked network of its own format.
        options.add_session_config_entry("session.load_model_format", "ONNX")
        try:
            return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common base
            raise self._cannot_run(error) from error

    def _cannot_run(self, error: Exception) -> AgentFileError:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return AgentFileError(f"{self.path} cannot be run by onnxruntime: {reason}")

    def run(self, names: list[str], inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Run the network.

        Args:
            names: Names of the wanted outputs.
            inputs: Batches by the names of the inputs.

        Returns:
            The outputs.

        Raises:
            AgentFileError: The batch takes too much memory, onnxruntime fails, or an output has another shape than the
                file declares, or is not finite.
        """
        rows = len(next(iter(inputs.values())))
        if rows * self.form.row_memory > LARGEST_BATCH_MEMORY:
            raise AgentFileError(
                f"{self.path} needs {self.form.row_memory} bytes for each of {rows} rows, at most "
                f"{LARGEST_BATCH_MEMORY} in total are allowed; run fewer environments at once"
            )
        try:
            outputs = self._session.run(names, dict(inputs))
        except Exception as error:  # as above
            raise self._cannot_run(error) from error
        for name, output in zip(names, outputs, strict=True):
            if output.shape != (rows, *self.form.outputs[name].shape):
                raise AgentFileError(f"{self.path} gave {name!r} of shape {output.shape} for {rows} rows")
            if not np.isfinite(output).all():
                raise AgentFileError(
                    f"{self.path} gave {name!r} that is not finite; its weights are damaged, or the observation is far "
                    "from those of its training"
                )
        return outputs


class OnnxNetwork:
    """A policy network: rows of observations and memory in, actions and the next memory out.

    Args:
        path: The ONNX file. Inputs `observation` (N, size) and, if it is recurrent, `memory` (N, M); outputs `action`
            (N, actions) and `next_memory` (N, M); all float32, N free.
        card: Card of the network.

    Raises:
        AgentFileError: An invalid file (see `NetworkSession`), or one with other inputs or outputs.
    """

    def __init__(self, path: Path, card: LearnedCard) -> None:
        self.path = path
        self._session = NetworkSession(path, card)
        form = self._session.form
        self.memory = card.memory
        names = [OBSERVATION, *([MEMORY] if self.memory else [])]
        if list(form.inputs) != names:
            raise AgentFileError(
                f"{path} must have the inputs observation and, if it remembers, memory, got {', '.join(form.inputs)}"
            )
        self.size = self._width(form.inputs, OBSERVATION)
        self.actions = self._width(form.outputs, ACTION)
        if self.memory:
            widths = self._width(form.inputs, MEMORY), self._width(form.outputs, NEXT_MEMORY)
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

        Raises:
            AgentFileError: The network fails; see `NetworkSession.run`.
        """
        if not self.memory:
            return self._session.run(self._outputs, {OBSERVATION: rows})[0], memory
        action, following = self._session.run(self._outputs, {OBSERVATION: rows, MEMORY: memory})
        return action, following

    def _width(self, ports: Mapping[str, Row], name: str) -> int:
        """Return the length of a row of an input or output."""
        if name not in ports:
            raise AgentFileError(f"{self.path} must have {name!r}, got {', '.join(ports)}")
        row = ports[name]
        if row.kind != FLOAT or len(row.shape) != 1:
            raise AgentFileError(
                f"{self.path}: {name} must be float32 of shape (N, known), got {TYPES[row.kind].name} "
                f"{('N', *row.shape)}"
            )
        return row.shape[0]
