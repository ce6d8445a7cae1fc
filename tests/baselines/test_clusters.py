"""A cluster of Dask or Ray computes the same rows as this machine alone, and a killed worker costs one task."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clusters import dask_cluster, end_at_once, fail_with, halves, ray_cluster, square_slowly, version_in_tests
from joblib import delayed

from servotrack.baselines.board.submit import registered_candidate, submit
from servotrack.baselines.board.suites import load_suite
from servotrack.baselines.papers.parts import PartTask, compute_parts, read_part, setting_of
from servotrack.baselines.running.clusters import check_shared, computing_on
from servotrack.baselines.running.stopping import WorkerLostError
from servotrack.baselines.running.workers import in_workers
from servotrack.baselines.tuning.search import TuningProtocol, default_values, measure_all

pytest.importorskip("distributed")
pytest.importorskip("ray")

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="looks for workers in /proc"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
CLUSTERS: dict[str, Callable[..., Any]] = {"dask": dask_cluster, "ray": ray_cluster}
ONE_IS_ENOUGH = pytest.mark.parametrize("cluster", ["dask"], indirect=True, scope="module")
"""For what is the same code with both: a new Ray worker takes seconds to start."""
TIMES = ("provenance", "step_seconds", "sha256")
"""Fields of a cell that may differ between two runs, and the digests over them."""


@pytest.fixture(scope="module", params=CLUSTERS)
def cluster(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    with CLUSTERS[request.param](tmp_path_factory.mktemp(request.param)) as address:
        yield request.param, address


def bench(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [
        sys.executable, "-m", "servotrack", "bench", "--env", "UncalibServo-v0", "--agents", "kf,random",
        "--levels", "0,3", "--episodes", "60",
        "--no-video", "--results", str(folder), *options,
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=folder.parent)


def rows_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Return all cells without what differs between two runs."""
    cells = {str(path.relative_to(folder)): json.loads(path.read_text()) for path in folder.glob("*/*.json")}
    for cell in cells.values():
        for name in TIMES:
            cell.pop(name)
    return cells


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("here") / "results"
    process = bench(folder, "--jobs", "1")
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()
    return folder


def test_a_cluster_computes_the_rows_of_one_process(cluster: tuple[str, str], here: Path, tmp_path: Path) -> None:
    backend, address = cluster
    process = bench(tmp_path / "results", "--backend", backend, "--scheduler", address)
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()
    found = rows_of(tmp_path / "results")
    assert len(found) == 4
    assert found == rows_of(here)


def test_a_killed_worker_costs_one_task(cluster: tuple[str, str], tmp_path: Path) -> None:
    victims: list[int] = []

    def kill_one() -> None:
        end = time.monotonic() + 60.0
        while not victims and time.monotonic() < end:
            for begun in tmp_path.glob("3.begun"):
                if text := begun.read_text().split():
                    victims.append(int(text[0]))
                    os.kill(victims[0], signal.SIGKILL)
            time.sleep(0.02)

    killer = threading.Thread(target=kill_one)
    killer.start()
    with computing_on(*cluster):
        found = list(in_workers([delayed(square_slowly)(number, tmp_path) for number in range(8)], -1, ordered=True))
    killer.join()
    assert found == [number * number for number in range(8)]
    attempts = {number: (tmp_path / f"{number}.begun").read_text().split() for number in range(8)}
    assert victims[0] == int(attempts[3][0])
    again = [number for number in attempts if len(attempts[number]) > 1]
    assert 3 in again
    # Dask also runs again what a lost worker had finished but not yet handed over.
    assert len(again) <= 2


def test_a_task_that_kills_every_worker_ends_by_a_message(cluster: tuple[str, str]) -> None:
    backend, address = cluster
    with (
        pytest.raises(WorkerLostError, match=f"the {backend} cluster at .* lost a task .*finished work is kept"),
        computing_on(backend, address),
    ):
        list(in_workers([delayed(end_at_once)()], -1))


@ONE_IS_ENOUGH
def test_an_error_of_a_task_is_raised_as_it_is(cluster: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match=r"^argument must be something else, got 7$"), computing_on(*cluster):
        list(in_workers([delayed(fail_with)("7")], -1))


@ONE_IS_ENOUGH
def test_parts_are_written_by_the_process_that_asks(cluster: tuple[str, str], tmp_path: Path) -> None:
    tasks = [PartTask(tmp_path / f"{k}.npz", setting_of(number=k), halves, (k,)) for k in range(5)]
    with computing_on(*cluster):
        done = list(compute_parts(tasks, -1))
    assert sorted(task.arguments[0] for task in done) == [0, 1, 2, 3, 4]
    assert [float(read_part(task.path, task.setting)["half"]) for task in tasks] == [0.0, 0.5, 1.0, 1.5, 2.0]


@ONE_IS_ENOUGH
def test_workers_of_another_version_are_refused(cluster: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    # The workers have this process's environment from the time when they started.
    monkeypatch.setenv("VERSION_IN_TESTS", "0.0.1+elsewhere")
    with (
        pytest.raises(ValueError, match=r"worker .* has servotrack none, the command 0\.0\.1"),
        computing_on(*cluster, version_in_tests),
    ):
        list(in_workers([delayed(fail_with)("7")], -1))


@ONE_IS_ENOUGH
def test_a_shared_folder_is_seen(cluster: tuple[str, str], tmp_path: Path) -> None:
    with computing_on(*cluster):
        check_shared(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_command_that_is_stopped_says_what_is_kept(cluster: tuple[str, str], tmp_path: Path) -> None:
    backend, address = cluster
    process = bench(tmp_path / "results", "--backend", backend, "--scheduler", address, "--episodes", "100000")
    time.sleep(6.0)
    process.send_signal(signal.SIGTERM)
    begin = time.monotonic()
    _, errors = process.communicate()
    assert time.monotonic() - begin < 6.0
    assert process.returncode == 128 + signal.SIGTERM
    assert "stopped by SIGTERM" in errors.decode()
    assert "Traceback" not in errors.decode()


@pytest.mark.parametrize(
    ("backend", "scheduler", "message"),
    [
        ("dusk", None, "backend must be one of processes, dask, ray, got 'dusk'; did you mean dask"),
        (
            "processes",
            "tcp://127.0.0.1:8786",
            "scheduler goes with the backends dask and ray, got 'tcp://127.0.0.1:8786'",
        ),
        (
            "dask",
            None,
            "backend dask needs the address of its scheduler, such as tcp://127.0.0.1:8786, by",
        ),
        ("ray", "127.0.0.1:9", "scheduler must be the address of a ray cluster that answers, got 127.0.0.1:9"),
        ("dask", "nonsense://", "scheduler must be the address of a dask cluster that answers, got nonsense://"),
    ],
)
def test_bad_arguments_are_refused(
    backend: str, scheduler: str | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DASK_SCHEDULER_ADDRESS", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match=message), computing_on(backend, scheduler):
        pass


@ONE_IS_ENOUGH
def test_a_search_on_a_cluster_chooses_the_same(cluster: tuple[str, str]) -> None:
    protocol = TuningProtocol(levels=(0, 1), seeds=(100_500, 100_501))
    settings = [default_values("broyden"), {**default_values("broyden"), "rate": 0.7}]
    here = list(measure_all("broyden", settings, protocol))
    with computing_on(*cluster):
        there = list(measure_all("broyden", settings, protocol))
    for ours, theirs in zip(here, there, strict=True):
        assert ours.steps == theirs.steps
        np.testing.assert_array_equal(ours.costs, theirs.costs)


@ONE_IS_ENOUGH
def test_a_submission_from_a_cluster_has_the_same_actions(cluster: tuple[str, str], tmp_path: Path) -> None:
    suite = load_suite("2027a")
    cells = [suite.cell("UncalibServo-v0,level=3")]
    candidate = registered_candidate("random", "")
    submit(candidate, suite, tmp_path / "here", cells)
    with computing_on(*cluster):
        submit(candidate, suite, tmp_path / "there", cells)
    for part in ("rows", "traces"):
        (here,), (there,) = ((tmp_path / place / part).iterdir() for place in ("here", "there"))
        assert here.read_bytes() == there.read_bytes()
