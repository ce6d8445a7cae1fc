"""Finished parts of a reproduction, one file each, so that a stopped reproduction goes on where it was."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from rich.progress import Progress

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.reporting.files import ResultsError, atomic_path
from servotrack.baselines.running.workers import in_workers

Arrays = Mapping[str, Any]
"""Arrays or numbers by name."""
_SETTING = "setting"


class PartTask(NamedTuple):
    """A part that is still to be computed.

    Attributes:
        path: File ending in .npz.
        setting: Line of `setting_of`.
        compute: Function that returns the part's `Arrays`; workers import it by its name.
        arguments: Arguments of `compute`.
    """

    path: Path
    setting: str
    compute: Callable[..., Arrays]
    arguments: tuple[Any, ...]


def setting_of(**values: Any) -> str:
    """Return the settings that a part's results depend on, with the version of the code, in one line."""
    return json.dumps({"version": code_version(), **values}, sort_keys=True)


def write_part(path: Path, setting: str, arrays: Arrays) -> None:
    """Write a part, whole or not at all.

    Args:
        path: File ending in .npz.
        setting: Line of `setting_of`.
        arrays: Results of the part; no name is "setting".
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{_SETTING: np.array(setting)}, **arrays)  # type: ignore[arg-type]


def read_part(path: Path, setting: str) -> dict[str, Any]:
    """Read a part.

    Raises:
        ResultsError: The file is damaged, or of another setting or version.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ResultsError(f"{path} cannot be read ({error}); delete it to compute it again") from error
    if str(stored.pop(_SETTING, None)) != setting:
        raise ResultsError(f"{path} holds runs of another setting or version; choose another --output, or delete it")
    return stored


def compute_parts(tasks: Sequence[PartTask], jobs: int) -> Iterator[PartTask]:
    """Compute parts in worker processes, or on a cluster, and yield each when it is written.

    This process writes: workers of a cluster may not see its folders.

    Args:
        tasks: Parts.
        jobs: Processes; -1 for all processors.

    Raises:
        StorageError: A file cannot be written.
        WorkerLostError: A worker was killed.
    """
    calls = (delayed(_computed)(number, task.compute, task.arguments) for number, task in enumerate(tasks))
    for number, arrays in in_workers(calls, jobs):
        task = tasks[number]
        write_part(task.path, task.setting, arrays)
        yield task


def _computed(number: int, compute: Callable[..., Arrays], arguments: tuple[Any, ...]) -> tuple[int, Arrays]:
    """Compute one part in a worker, which has to register the ids first."""
    import servotrack  # noqa: F401

    return number, compute(*arguments)


def part(path: Path, setting: str, compute: Callable[[], Arrays]) -> dict[str, Any]:
    """Return a part: that of the file, or a new one, which is written first.

    Args:
        path: File ending in .npz.
        setting: Line of `setting_of`.
        compute: Computes the part's results.

    Raises:
        ResultsError: The file is damaged, of another setting or version, or cannot be written.
    """
    if not path.exists():
        write_part(path, setting, compute())
    return read_part(path, setting)


def parts_of_seeds(
    folder: Path,
    count: int,
    compute: Callable[[int], Arrays],
    advance: Callable[[], object] | None = None,
    **setting: Any,
) -> list[dict[str, Any]]:
    """Return the parts of the first test seeds, computed or read, one file per seed.

    Args:
        folder: Folder of the files.
        count: Number of seeds.
        compute: Computes the results of a seed.
        advance: Called after each part, to move a progress bar.
        **setting: Values that the results depend on, beside the seed and the version of the code.

    Raises:
        ResultsError: A file is damaged, of another setting or version, or cannot be written.
    """
    found = []
    for seed in seeds.take("test", count):
        found.append(part(folder / f"{seed}.npz", setting_of(seed=seed, **setting), partial(compute, seed)))
        if advance is not None:
            advance()
    return found


def shown_parts_of_seeds(
    progress: Progress, label: str, folder: Path, count: int, compute: Callable[[int], Arrays], **setting: Any
) -> list[dict[str, Any]]:
    """Return `parts_of_seeds` with a progress bar of this label; the other arguments and errors are those of it."""
    bar = progress.add_task(label, total=count)
    return parts_of_seeds(folder, count, compute, lambda: progress.advance(bar), **setting)
