"""Worker processes that end with the process that started them, and import nothing from the working directory."""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import signal
import sys
import sysconfig
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextvars import ContextVar
from importlib import metadata
from types import FrameType
from typing import Any, NoReturn

from joblib import Parallel, delayed
from joblib.parallel import BACKENDS, get_active_backend

from servotrack._import_path import without_appended
from servotrack.baselines.running import unfinished
from servotrack.baselines.running.stopping import Stopped, WorkerLostError, stop_behind

Call = tuple[Callable[..., Any], Sequence[Any], Mapping[str, Any]]
"""A call as `joblib.delayed` makes it: function, arguments, keywords."""

_PARENT_INTERVAL = 0.5
"""Time between two looks for the parent process, s."""
_LEAVING = 0.7
"""Time after a signal at which a worker ends, s. joblib kills the others as soon as the first has ended."""
_FORCED = 1.5
"""Time after a signal at which a worker ends even if its task does not let it, s."""
_SAFE_PATH = "PYTHONSAFEPATH"


def _version_of_package() -> str:
    return metadata.version("servotrack")


VERSION_OF: ContextVar[Callable[[], str]] = ContextVar("VERSION_OF", default=_version_of_package)
"""Version of the code that workers of a cluster must share."""


def in_workers(calls: Iterable[Call], jobs: int, *, ordered: bool = False) -> Iterator[Any]:
    """Run calls in worker processes and yield their results.

    Workers stop on SIGTERM, leave SIGINT and SIGHUP to this process, and end within seconds if it is killed. Their
    import path is this process's own. Where a cluster computes (`running.clusters.computing_on`, or another backend
    of joblib chosen by `joblib.parallel_config`) all its workers take part, each with this version of the package.

    Args:
        calls: Calls made by `joblib.delayed`.
        jobs: Number of processes, as in joblib; -1 uses all processors. 1 runs the calls in this process.
        ordered: True yields results in the order of the calls, False as soon as they are there.

    Raises:
        WorkerLostError: A worker was killed, for example because memory ran out.
        ValueError: A worker of a cluster has another version of the package.
    """
    options: dict[str, Any] = {"return_as": "generator" if ordered else "generator_unordered", "batch_size": 1}
    with contextlib.ExitStack() as stack:
        own = jobs != 1 and not on_cluster()
        if own:
            stack.enter_context(_safe_path())
        # The processes start before the first result.
        with without_appended() if own else contextlib.nullcontext(()) as folders:
            if own:
                options |= {"initializer": _enter, "initargs": (os.getpid(), os.getcwd(), folders)}
            if own and sys.version_info < (3, 11):
                _start_elsewhere(jobs, options)
            run: Callable[..., Any] = _run
            if on_cluster():
                version_of = VERSION_OF.get()
                run, jobs = functools.partial(_run_elsewhere, version_of, version_of()), -1
            results = Parallel(n_jobs=jobs, **options)(delayed(run)(*call) for call in calls)
        try:
            yield from results
        except GeneratorExit:
            with warnings.catch_warnings():
                # joblib warns of results that are not used.
                warnings.simplefilter("ignore")
                results.close()
            raise
        except BrokenProcessPool as error:
            raise WorkerLostError(
                "a worker process was killed, perhaps for lack of memory; finished work is kept: run the same command "
                "to go on, with fewer jobs if memory is short"
            ) from error


def on_cluster() -> bool:
    """Return True if calls run elsewhere than in processes of this machine, so that its processors are no limit."""
    return not isinstance(get_active_backend()[0], BACKENDS["loky"])


@contextlib.contextmanager
def _safe_path() -> Iterator[None]:
    """Context in which new Python processes do not import from the working directory."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_SAFE_PATH, None)
        else:
            os.environ[_SAFE_PATH] = before


def _start_elsewhere(jobs: int, options: Mapping[str, Any]) -> None:
    """Start the workers in the folder of the standard library: Python 3.10 has no safe path. `_enter` takes them back.

    The folder exists as long as a slow worker needs to start, and holds only what Python would import anyway.
    """
    here = os.getcwd()
    os.chdir(sysconfig.get_path("stdlib"))
    try:
        for _ in Parallel(n_jobs=jobs, **options)([delayed(int)(), delayed(int)()]):
            pass
    finally:
        os.chdir(here)


class _Worker:
    """State of a worker process.

    Args:
        parent: Process id of the parent.

    Attributes:
        parent: Process id of the parent.
        busy: True while a task runs.
        stopped: Time of the signal, s; None before it.
    """

    def __init__(self, parent: int) -> None:
        self.parent = parent
        self.busy = False
        self.stopped: float | None = None
        self._raised = False
        self._unraisable = sys.unraisablehook

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Leave at once if no task runs; else interrupt it, so that it removes its unfinished files."""
        if self._raised:
            return
        self._raised = True
        if self.stopped is None:
            self.stopped = time.monotonic()
            threading.Thread(target=self._leave_by_force, daemon=True).start()
        if not self.busy:
            self.leave()
        raise Stopped(number)

    def on_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Raise again what was raised where nothing can be, as in a finalizer or while kernels are compiled."""
        if not isinstance(unraisable.exc_value, Stopped):
            self._unraisable(unraisable)
            return
        self._raised = False
        timer = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGTERM))
        timer.daemon = True
        timer.start()

    def leave(self) -> NoReturn:
        """End this process."""
        unfinished.clear()
        if os.getppid() == self.parent and self.stopped is not None:
            time.sleep(max(self.stopped + _LEAVING - time.monotonic(), 0.0))
        os._exit(128 + signal.SIGTERM)

    def watch_parent(self) -> None:
        """Stop when the parent has ended, however it did."""
        while os.getppid() == self.parent:
            time.sleep(_PARENT_INTERVAL)
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGTERM)
        # Reached without effect only if the signal is lost.
        self._leave_by_force()

    def _leave_by_force(self) -> None:
        time.sleep(_FORCED)
        unfinished.clear()
        os._exit(128 + signal.SIGTERM)


_worker: _Worker | None = None


def _enter(parent: int, here: str, folders: Sequence[str]) -> None:
    """Prepare a worker process: its working directory, the folders at the end of its import path, and how it ends."""
    global _worker
    os.chdir(here)
    sys.path.extend(folders)
    if os.name != "posix":
        return
    _worker = _Worker(parent)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _worker.on_signal)
    sys.unraisablehook = _worker.on_unraisable
    threading.Thread(target=_worker.watch_parent, daemon=True).start()


def _run_elsewhere(
    version_of: Callable[[], str],
    version: str,
    function: Callable[..., Any],
    arguments: Sequence[Any],
    keywords: Mapping[str, Any],
) -> Any:
    """Run one call on a worker of a cluster, whose code must be that of the command."""
    if (own := version_of()) != version:
        raise ValueError(
            f"worker {platform.node()} has servotrack {own}, the command {version} (after the + a digest of the "
            "sources); install the same on both"
        )
    return function(*arguments, **keywords)


def _run(function: Callable[..., Any], arguments: Sequence[Any], keywords: Mapping[str, Any]) -> Any:
    """Run one call, in a worker or, with one job, in the process itself."""
    if _worker is None:
        return function(*arguments, **keywords)
    _worker.busy = True
    try:
        return function(*arguments, **keywords)
    except BaseException as error:
        if stop_behind(error) is not None:
            _worker.leave()
        raise
    finally:
        _worker.busy = False
