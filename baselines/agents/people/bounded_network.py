"""A network of the user in onnxruntime, within limits of time and memory."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.onnx_file.expansion import check_expansion
from servotrack.baselines.agents.learned.onnx_file.references import check_self_contained
from servotrack.baselines.reporting.files import ResultsError, read_bounded

LARGEST_FILE = 1 << 31
"""Largest accepted size of a file, bytes; ONNX files cannot be larger."""
LONGEST_RUN = 60.0
"""Time after which a frame is given up, s. onnxruntime stops at the end of the operator that it computes."""
LARGEST_MEMORY = 1 << 32
"""Largest memory of weights and intermediate tensors on the processor, of all networks of the process, bytes."""
_LONGEST_METADATA = 100_000
_SAME_AS_REQUESTED = 1
"""onnxruntime's number of the strategy by which its memory grows; the other one doubles it."""


class BoundedNetwork:
    """A network that may use every operator of onnxruntime, but not endless time or memory.

    Args:
        path: The ONNX file, which must hold its weights itself.

    Attributes:
        path: The ONNX file.
        inputs: Inputs as onnxruntime describes them: `name`, `shape` and `type`.
        outputs: Names of the outputs.
        metadata: Metadata of the file, texts by name.

    Raises:
        ResultsError: The file is missing, not regular, too large, no ONNX, refers to other files, or cannot be run.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        content = read_bounded(path, LARGEST_FILE)
        try:
            check_self_contained(content)
            check_expansion(content)
        except ValueError as error:
            raise ResultsError(f"{path} cannot be used: {error}") from error
        try:
            self._session = onnxruntime.InferenceSession(content, _options(), providers=_providers())
            # Texts that are not UTF-8 fail here.
            self.inputs = list(self._session.get_inputs())
            self.outputs = [port.name for port in self._session.get_outputs()]
            found = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # onnxruntime's errors have no common base
            raise self._cannot_run(error) from error
        self.metadata = {str(key): str(text)[:_LONGEST_METADATA] for key, text in found.items()}

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return the outputs by name.

        Args:
            inputs: Arrays by the names of the inputs.

        Raises:
            ResultsError: The network fails, takes more than `LONGEST_RUN` or `LARGEST_MEMORY`, or gives NaN or
                something else than arrays of numbers.
        """
        options = onnxruntime.RunOptions()
        try:
            with _terminated_after(LONGEST_RUN, options):
                found = self._session.run(None, dict(inputs), options)
        except Exception as error:  # as above
            if options.terminate:
                raise ResultsError(
                    f"{self.path} needs more than {LONGEST_RUN:.0f} s for a frame; use a smaller network or input"
                ) from error
            raise self._cannot_run(error) from error
        outputs = dict(zip(self.outputs, found, strict=True))
        for name, values in outputs.items():
            if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
                raise ResultsError(f"{self.path}: output {name} must be an array of numbers; export the network anew")
            if values.dtype.kind == "f" and values.size and np.isnan(values.min()):
                raise ResultsError(
                    f"{self.path} gives NaN in {name}; its weights are damaged, or 16 bits are too few: export it with "
                    "32 bits"
                )
        return outputs

    def _cannot_run(self, error: Exception) -> ResultsError:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "bfc_arena" in reason:
            reason = f"it needs more than {LARGEST_MEMORY >> 30} GiB; use a smaller network or input"
        return ResultsError(f"{self.path} cannot be run by onnxruntime: {reason[:200]}")


def _options() -> onnxruntime.SessionOptions:
    _bound_memory()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    # Otherwise onnxruntime guesses from the bytes, and may read a file of its own format.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.use_env_allocators", "1")
    return options


@functools.cache
def _bound_memory() -> None:
    """Give onnxruntime an allocator with a limit, which sessions use that ask for it. A process can have only one."""
    place = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    limits = onnxruntime.OrtArenaCfg({"max_mem": LARGEST_MEMORY, "arena_extend_strategy": _SAME_AS_REQUESTED})
    onnxruntime.create_and_register_allocator(place, limits)


def _providers() -> list[str]:
    wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
    return [name for name in wanted if name in onnxruntime.get_available_providers()]


@contextlib.contextmanager
def _terminated_after(seconds: float, options: onnxruntime.RunOptions) -> Iterator[None]:
    """Context of one run, which is terminated if it takes longer."""
    timer = threading.Timer(seconds, setattr, (options, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
