"""Real clusters on this machine, with two workers each, on the loopback interface."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
LOOPBACK = "127.0.0.1"
START_TIME = 90.0


@contextlib.contextmanager
def dask_cluster(folder: Path, workers: int = 2) -> Iterator[str]:
    """Start a scheduler and workers; yield its address."""
    address = f"tcp://{LOOPBACK}:{_free_port()}"
    scheduler = [str(BIN / "dask"), "scheduler", "--host", LOOPBACK, "--port", address.rpartition(":")[2]]
    worker = [str(BIN / "dask"), "worker", address, "--host", LOOPBACK, "--nthreads", "1", "--nworkers", "1"]
    with contextlib.ExitStack() as stack:
        stack.enter_context(_running([*scheduler, "--no-dashboard"], folder / "scheduler.log"))
        _wait_for(address.rpartition(":")[2])
        for number in range(workers):
            place = ["--no-dashboard", "--local-directory", str(folder / f"worker{number}")]
            stack.enter_context(_running([*worker, *place], folder / f"worker{number}.log"))
        from distributed import Client

        with Client(address, timeout=START_TIME) as client:
            client.wait_for_workers(workers, timeout=START_TIME)
        yield address


@contextlib.contextmanager
def ray_cluster(folder: Path, workers: int = 2) -> Iterator[str]:
    """Start a head that runs as many tasks at a time as `workers`; yield its address."""
    port = _free_port()
    # Sockets of Ray must have short paths.
    command = [
        str(BIN / "ray"), "start", "--head", "--block", f"--port={port}", f"--node-ip-address={LOOPBACK}",
        f"--num-cpus={workers}", "--include-dashboard=false", "--disable-usage-stats",
        "--object-store-memory=100000000",
    ]  # fmt: skip
    with _running(command, folder / "ray.log"):
        _wait_for(str(port))
        yield f"{LOOPBACK}:{port}"


def square_slowly(number: int, folder: Path) -> int:
    """Say that it runs, take some time, and return a square."""
    with (folder / f"{number}.begun").open("a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.4)
    return number * number


def end_at_once() -> None:
    """Kill the own process."""
    os.kill(os.getpid(), signal.SIGKILL)


def fail_with(value: str) -> None:
    """Raise the error of a task."""
    raise ValueError(f"argument must be something else, got {value}")


def version_in_tests() -> str:
    """Return the version of an environment variable."""
    return os.environ.get("VERSION_IN_TESTS", "none")


def halves(number: int) -> dict[str, Any]:
    """Return the arrays of a part."""
    return {"half": number / 2.0}


@contextlib.contextmanager
def _running(command: Sequence[str], log: Path) -> Iterator[subprocess.Popen[Any]]:
    # Workers import the functions of this file.
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(__file__).parent),
        "OMP_NUM_THREADS": "1",
        "RAY_DISABLE_IMPORT_WARNING": "1",
        # A token that another program has left would be asked for.
        "RAY_AUTH_MODE": "disabled",
    }
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, env=environment, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(4.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _wait_for(port: str) -> None:
    end = time.monotonic() + START_TIME
    while True:
        try:
            socket.create_connection((LOOPBACK, int(port)), 1.0).close()
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)
        else:
            return
