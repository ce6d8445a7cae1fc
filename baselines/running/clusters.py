"""Clusters that compute instead of processes of this machine: a Dask scheduler or a Ray head, behind joblib."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from joblib import delayed, parallel_config

from servotrack.baselines.running.stopping import GO_ON, WorkerLostError
from servotrack.baselines.running.workers import VERSION_OF, in_workers

BACKENDS = ("processes", "dask", "ray")
"""What runs the tasks of a command: processes of this machine, or a cluster."""
ANSWER_TIME = 10.0
"""Longest time in which a scheduler answers, s."""
_ROOMS = {"dask": "servotrack.baselines.running.dask_cluster", "ray": "servotrack.baselines.running.ray_cluster"}
_ENVIRONMENT = {"dask": "DASK_SCHEDULER_ADDRESS", "ray": "RAY_ADDRESS"}
_EXAMPLES = {"dask": "tcp://127.0.0.1:8786", "ray": "127.0.0.1:6379"}


@contextlib.contextmanager
def computing_on(
    backend: str = "processes", scheduler: str | None = None, version_of: Callable[[], str] | None = None
) -> Iterator[None]:
    """Context in which `in_workers` runs its calls on a cluster.

    A worker that is killed costs the task that it had: the cluster runs it again elsewhere, up to three times.

    Args:
        backend: One of `BACKENDS`.
        scheduler: Address of the Dask scheduler or Ray head. None takes that of the environment variable
            DASK_SCHEDULER_ADDRESS or RAY_ADDRESS.
        version_of: Returns the version of the code, which workers must share with this process; None for the package's.

    Raises:
        ValueError: An unknown backend, no address, or none that answers and has workers.
        ImportError: The backend's library is missing.
        WorkerLostError: The scheduler was lost, or a task with all its attempts.
    """
    if backend not in BACKENDS:
        near = difflib.get_close_matches(backend, BACKENDS, n=1)
        remedy = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}{remedy}")
    if backend == "processes":
        if scheduler is not None:
            raise ValueError(f"scheduler goes with the backends dask and ray, got {scheduler!r} with processes")
        yield
        return
    address = scheduler or os.environ.get(_ENVIRONMENT[backend])
    if not address:
        raise ValueError(
            f"backend {backend} needs the address of its scheduler, such as {_EXAMPLES[backend]}, by --scheduler or "
            f"{_ENVIRONMENT[backend]}, got none"
        )
    try:
        cluster = importlib.import_module(_ROOMS[backend])
    except ModuleNotFoundError as error:
        raise ImportError(
            f"backend {backend} needs {error.name}; install the extra: pip install 'servotrack[cluster]'"
        ) from error
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(cluster.connected(address, ANSWER_TIME))
        except (OSError, RuntimeError, ValueError) as error:
            raise ValueError(
                f"scheduler must be the address of a {backend} cluster that answers, got {address} ({_short(error)})"
            ) from error
        stack.enter_context(parallel_config(backend=backend, n_jobs=-1))
        if version_of is not None:
            stack.callback(VERSION_OF.reset, VERSION_OF.set(version_of))
        try:
            yield
        except cluster.LOSSES as error:
            raise WorkerLostError(
                f"the {backend} cluster at {address} lost a task ({type(error).__name__}: {_short(error)}); "
                f"finished work is kept: {GO_ON}"
            ) from error


def check_shared(folder: Path) -> None:
    """Hold a folder against what a worker of the cluster sees, before it computes for hours.

    Raises:
        ValueError: The worker sees another folder.
    """
    with tempfile.NamedTemporaryFile(prefix=".shared-", dir=folder) as mark:
        name = Path(mark.name).resolve()
        if not all(in_workers([delayed(name.exists)()], -1)):
            raise ValueError(
                f"output must be a folder that this machine and all workers share, got {folder.resolve()}, in which a "
                "worker does not see a file of this machine's"
            )


def _short(error: BaseException) -> str:
    """First line of an error's text."""
    return next((line for line in map(str.strip, str(error).splitlines()) if line), type(error).__name__)
