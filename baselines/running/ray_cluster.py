"""Tasks on a Ray cluster.

Ray's own backend of joblib keeps a pool of actors, which gives results only when all are there, and which one killed
actor ends. A plain task is repeated by Ray itself.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import ray
from joblib import register_parallel_backend
from ray.exceptions import NodeDiedError, OutOfMemoryError, RaySystemError, RayTaskError, WorkerCrashedError

from servotrack.baselines.running.cluster_tasks import ClusterTasks
from servotrack.baselines.running.stopping import SIGNALS

LOSSES = (NodeDiedError, OutOfMemoryError, RaySystemError, WorkerCrashedError)
"""Errors that mean that the head, or a task with all its attempts, is gone."""
ATTEMPTS_AFTER_LOSS = 3
"""Further attempts of a task whose worker is lost, as Dask has them. An error that a task raises itself is final."""


@contextlib.contextmanager
def connected(address: str, answer_time: float) -> Iterator[None]:
    """Context with a connection to a Ray head.

    Args:
        address: Address of the head.
        answer_time: Longest time in which it takes a connection, s.

    Raises:
        OSError: The head does not answer, or asks for a token.
        RuntimeError: The head has another version of Ray or Python.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        # Ray itself waits for minutes.
        socket.create_connection((host, int(port)), answer_time).close()
    # Ray takes SIGTERM for itself, which would end the command without its last words.
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except ConnectionError as error:
        raise ConnectionError("no connection; if the head asks for a token, set RAY_AUTH_MODE=token") from error
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    try:
        register_parallel_backend("ray", RayTasks)
        yield
    finally:
        ray.shutdown()


@ray.remote(max_retries=ATTEMPTS_AFTER_LOSS, num_cpus=1)
def _call(function: Callable[[], Any]) -> Any:
    return function()


class RayTasks(ClusterTasks):
    """Tasks of the head that this process is connected to."""

    def cores(self) -> int:
        """Return the number of processors of the cluster."""
        return int(ray.cluster_resources().get("CPU", 1))

    def start(self, function: Callable[[], Any]) -> Future[Any]:
        """Start a task."""
        reference = _call.remote(function)
        future: Future[Any] = reference.future()
        future.reference = reference  # type: ignore[attr-defined]
        return future

    def result(self, future: Future[Any]) -> Any:
        """Return the result of a task that is done."""
        try:
            return future.result()
        except RayTaskError as error:
            raise getattr(error, "cause", None) or error from None

    def cancel(self, futures: list[Future[Any]]) -> None:
        """Give up tasks, those that run too."""
        for future in futures:
            ray.cancel(future.reference, force=True)  # type: ignore[attr-defined]
