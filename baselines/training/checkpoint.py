"""Checkpoints of trainings: a NumPy archive of tensors, with their structure as JSON. Nothing is unpickled."""

from __future__ import annotations

import json
import random
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from servotrack.baselines.reporting.files import ResultsError, atomic_path

CHECKPOINT = "checkpoint.npz"
"""Name of the checkpoint in the folder of a run."""
_EARLIER = "checkpoint.pt"
_STRUCTURE = "structure"


def write_checkpoint(folder: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint; an earlier one is replaced only once the new one is complete.

    Args:
        folder: Folder of the run.
        content: Nested mappings, lists and tuples of tensors, arrays, numbers and text.

    Raises:
        TypeError: Another type inside.
    """
    arrays: dict[str, NDArray[Any]] = {}
    structure = json.dumps(_flatten(content, arrays), allow_nan=False)
    with atomic_path(folder / CHECKPOINT) as temporary, temporary.open("wb") as file:
        np.savez(file, **{_STRUCTURE: np.array(structure)}, **arrays)  # type: ignore[arg-type]


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the newest checkpoint of a run; None if there is none.

    Raises:
        ResultsError: A file that is not a checkpoint, or a checkpoint of an earlier version.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        if (folder / _EARLIER).exists():
            raise ResultsError(f"{folder / _EARLIER} is of an earlier version; move its folder away to start again")
        return None
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        content: dict[str, Any] = _restored(json.loads(str(arrays.pop(_STRUCTURE))), arrays)
        if {"parameters", "steps", "curve", "random"} <= set(content):
            return content
        reason = "it lacks parameters, steps, curve or random"
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
    raise ResultsError(f"{path} is not a checkpoint ({reason}); move its folder away to start again")


def random_states() -> dict[str, Any]:
    """Return the states of the global random generators of torch, NumPy and Python."""
    version, words, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - Stable-Baselines3 uses this generator
        "python": {"version": version, "words": np.array(words, dtype=np.uint64), "gauss": gauss},
    }


def restore_random_states(states: Mapping[str, Any]) -> None:
    """Set the global random generators to the states of `random_states`."""
    torch.set_rng_state(states["torch"])
    np.random.set_state(states["numpy"])  # noqa: NPY002
    python = states["python"]
    random.setstate((python["version"], tuple(python["words"].tolist()), python["gauss"]))


def _flatten(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return the structure of a value as JSON can hold it; tensors and arrays go into `arrays`."""
    if isinstance(value, (torch.Tensor, np.ndarray)):
        name = str(len(arrays))
        tensor = isinstance(value, torch.Tensor)
        arrays[name] = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
        return {"tensor" if tensor else "array": name}
    if isinstance(value, Mapping):
        return {"mapping": [[key, _flatten(part, arrays)] for key, part in value.items()]}
    if isinstance(value, (list, tuple)):
        return {type(value).__name__: [_flatten(part, arrays) for part in value]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a checkpoint holds tensors, arrays, numbers and text, got {type(value).__name__}")


def _restored(structure: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if not isinstance(structure, dict):
        return structure
    ((kind, content),) = structure.items()
    if kind == "tensor":
        return torch.from_numpy(np.array(arrays[content]))
    if kind == "array":
        return arrays[content]
    if kind == "mapping":
        return {key: _restored(part, arrays) for key, part in content}
    parts = [_restored(part, arrays) for part in content]
    return tuple(parts) if kind == "tuple" else parts
