"""Tasks on a Dask cluster."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Callable, Iterator
from typing import Any

from distributed import Client, Future, KilledWorker, get_client
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError
from joblib import register_parallel_backend

from servotrack.baselines.running.cluster_tasks import ClusterTasks

LOSSES = (KilledWorker, CommClosedError, FutureCancelledError)
"""Errors that mean that the scheduler, or a task with all its attempts, is gone."""


@contextlib.contextmanager
def connected(address: str, answer_time: float) -> Iterator[None]:
    """Context with a connection to a Dask scheduler.

    Args:
        address: Address of the scheduler.
        answer_time: Longest time in which it answers, and then in which it has its first worker, s.

    Raises:
        OSError: The scheduler does not answer.
        RuntimeError: It has no workers.
    """
    with Client(address, timeout=answer_time) as client:
        try:
            client.wait_for_workers(1, timeout=answer_time)
        except TimeoutError as error:
            raise RuntimeError(f"no worker within {answer_time:g} s; start some: dask worker {address}") from error
        register_parallel_backend("dask", DaskTasks)
        yield


class DaskTasks(ClusterTasks):
    """Tasks of the Dask client of this process. Dask repeats a task whose worker is lost."""

    def cores(self) -> int:
        """Return the number of threads of all workers."""
        return sum(get_client().nthreads().values())

    def start(self, function: Callable[[], Any]) -> Future:
        """Start a task."""
        return get_client().submit(function, key=f"servotrack-{uuid.uuid4()}", pure=False)

    def result(self, future: Future) -> Any:
        """Return the result of a task that is done."""
        return future.result()

    def cancel(self, futures: list[Future]) -> None:
        """Give up tasks; one that runs on a worker ends there unheard."""
        get_client().cancel(futures, force=True)
