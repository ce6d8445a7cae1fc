"""The common part of the backends of clusters: every call of joblib is one task of the cluster."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

from joblib.parallel import ParallelBackendBase


class ClusterTasks(ParallelBackendBase):  # type: ignore[misc]
    """Backend of joblib that starts one task of a cluster for every batch of calls."""

    supports_retrieve_callback = True

    @abc.abstractmethod
    def cores(self) -> int:
        """Return the number of tasks that the cluster runs at a time."""

    @abc.abstractmethod
    def start(self, function: Callable[[], Any]) -> Any:
        """Start a task; return its future, with `add_done_callback`."""

    @abc.abstractmethod
    def result(self, future: Any) -> Any:
        """Return the result of a task that is done, or raise its error as it was raised in the task."""

    @abc.abstractmethod
    def cancel(self, futures: list[Any]) -> None:
        """Give up tasks whose results are not wanted any more."""

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Return the number of tasks at a time, whatever `n_jobs` says and this machine has.

        With one, joblib would run the calls in this process.
        """
        return max(2, self.cores())

    def configure(self, n_jobs: int = 1, parallel: Any = None, **options: Any) -> int:
        """Begin; joblib calls this for every `Parallel`."""
        self.parallel = parallel
        self._waiting: set[Any] = set()
        return self.effective_n_jobs(n_jobs)

    def submit(self, func: Callable[[], Any], callback: Callable[[Any], None] | None = None) -> Any:
        """Start a task, and call `callback` with its future when it is done."""
        future = self.start(func)
        self._waiting.add(future)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Any) -> Any:
        """Return what the callback's future holds."""
        self._waiting.discard(out)
        return self.result(out)

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """Give up all tasks that run or wait."""
        self.cancel(list(self._waiting))
        self._waiting.clear()
