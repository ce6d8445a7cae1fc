"""Signals at random times: a command ends within 5 s, leaves valid files and nothing hidden, and goes on later.

The resumed command ends with the result of a run that was not stopped. The slow sweep takes some minutes for each
command and signal, `reproduce in workers` up to ten; `-s` shows how far it is. Do not edit the package meanwhile:
results of another version of the code are computed anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from servotrack.baselines.running import unfinished
from servotrack.baselines.running.stopping import Interruption, Stopped, keeping, undisturbed

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")

TIMES = 20
"""Random times per command and signal of the slow test."""
LONGEST_WAIT = 30.0
"""Longest time before a signal, s. Commands that take longer go on where they were stopped."""
LONGEST_END = 5.0
"""Time within which all processes must have ended, s, on a machine that is not overloaded."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PROGRAM = [sys.executable, "-m", "servotrack"]
SHORT = ("--set", "horizon=100", "--split", "tune")
TRAIN = ("train", "UncalibServo-v0", "--settings", "mine.yml", "--set", "horizon=80", "-o", "runs")
HYPER_PARAMETERS = """ppo:
  n_envs: 8
  n_timesteps: 4096
  measurements: 8
  encoding: {kind: servo}
  n_steps: 32
  batch_size: 64
"""


@dataclass(frozen=True)
class Command:
    """A command with the results that do not depend on time.

    Attributes:
        arguments: Arguments of the program.
        content: Returns the results in the working directory; all files that it reads must be valid.
        before: Commands that prepare the working directory.
        longest_wait: Longest time before a signal, s. A command that is resumed does not start from zero, so that
            shorter times reach all of its parts too.
    """

    arguments: tuple[str, ...]
    content: Callable[[Path], Any]
    before: tuple[tuple[str, ...], ...] = ()
    longest_wait: float = LONGEST_WAIT


def rows(folder: Path) -> Any:
    return {
        str(path.relative_to(folder)): sorted(json.loads(path.read_text())["rows"], key=lambda row: row["seed"])
        for path in folder.rglob("*/*.json")
    }


def digests(folder: Path, *patterns: str) -> Any:
    paths = [path for pattern in patterns for path in folder.rglob(pattern) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def frames(folder: Path) -> Any:
    """Digests of the pictures of films, whose files have random identifiers."""
    found = {}
    for path in folder.rglob("*.webm"):
        reader, digest = cv2.VideoCapture(str(path)), hashlib.sha256()
        while (picture := reader.read())[0]:
            digest.update(picture[1].tobytes())
        found[path.name] = digest.hexdigest()
    return found


def page(folder: Path) -> Any:
    """Lines of a leaderboard without its column of times, which were measured anew."""
    path = folder / "page" / "leaderboard.md"
    if not path.exists():
        return ()
    lines, times = [], None
    for line in path.read_text().splitlines():
        columns = line.split("|")
        found = [k for k, column in enumerate(columns) if "µs" in column]
        times = found[0] if found and len(columns) > 2 else times
        if times is not None and len(columns) > times:
            columns[times] = ""
        lines.append("|".join(columns))
    return tuple(lines)


def parts(folder: Path) -> Any:
    found = {}
    for path in folder.rglob("*.npz"):
        with np.load(path) as file:
            found[str(path.relative_to(folder))] = {
                name: file[name].tobytes() for name in file.files if not name.endswith("seconds")
            }
    return found


def tuned(folder: Path) -> Any:
    document = json.loads((folder / "tuning.json").read_text()) if (folder / "tuning.json").exists() else {"agents": {}}
    return {name: (agent["chosen"], agent["candidates"]) for name, agent in document["agents"].items()}


def tracks(folder: Path) -> Any:
    out = folder / "out"
    if (out / "tracks.mp4").exists():
        assert cv2.VideoCapture(str(out / "tracks.mp4")).read()[0], "a film that does not play"
    return (out / "tracks.txt").read_text() if (out / "tracks.txt").exists() else ""


def counted(folder: Path) -> Any:
    """Tracks and counts, whose rows must be complete, and the files made of the tracks."""
    out = folder / "out"
    rows = (out / "counts.csv").read_text().splitlines() if (out / "counts.csv").exists() else []
    assert all(len(row.split(",")) == 7 for row in rows)
    frames = [int(row.split(",")[0]) for row in rows[1:]]
    assert [frame for frame in frames if frames.count(frame) != 4] == []
    if (out / "tracks.json").exists():
        json.loads((out / "tracks.json").read_text())
    return tracks(folder), rows, digests(out, "tracks.csv", "tracks.json", "tracks_offline.txt")


def points(folder: Path) -> Any:
    """Tracks of points; the files of a run appear together."""
    found = digests(folder / "out", "tracks.csv", "tracks.geojson")
    assert len(found) in (0, 2)
    assert (folder / "out" / "tracks.png").exists() == bool(found)
    return found


COMMANDS = {
    "evaluate": Command(("evaluate", "UncalibServo-v0", "kf", "-n", "300", *SHORT, "-o", "out"), rows),
    "bench": Command(
        (
            "bench",
            "--env",
            "UncalibServo-v0",
            "-a",
            "kf,ukf,random",
            "-l",
            "0-2",
            "-n",
            "30",
            *SHORT,
            "-j",
            "2",
            "-o",
            "out",
            "--no-video",
        ),
        rows,
    ),
    "leaderboard": Command(
        ("leaderboard", "out", "--output", "page"),
        page,
        tuple(
            ("evaluate", "UncalibServo-v0", agent, "-n", "4", *SHORT, "-o", "out")
            for agent in ("kf", "random", "oracle")
        ),
    ),
    "track": Command(("track", "walk.avi", "--out", "out", "--background", "0"), tracks),
    "track with counts": Command(
        (
            "track",
            "walk.avi",
            "--out",
            "out",
            "--background",
            "0",
            "--zone",
            "1,1,90,1,90,90",
            "--line",
            "60,0,60,96",
            "--tracks",
            "csv,coco",
            "--offline",
            "--no-video",
        ),
        counted,
    ),
    "track points": Command(("track", "points.csv", "--out", "out"), points),
    "render": Command(("render", "scene", "--set", "horizon=150"), lambda folder: digests(folder, "scene/**/*")),
    "play": Command(("play", "--agent", "kf", "--seed", "3", "--video", "film.webm"), frames),
    "tune": Command(("tune", "kf", "broyden", "-n", "1", "-o", "tuning.json"), tuned),
    "train": Command((*TRAIN, "--seeds", "0"), lambda folder: digests(folder, "*.onnx")),
    "train in workers": Command((*TRAIN, "--seeds", "0-1", "-j", "2"), lambda folder: digests(folder, "*.onnx")),
    "compare": Command(
        ("compare", "runs/UncalibServo-v0,horizon=80", "ppo", "kf", "-n", "60", "--split", "tune", "-o", "cells"),
        lambda folder: rows(folder / "cells"),
        ((*TRAIN, "--seeds", "0-1", "--steps", "256"),),
    ),
    "reproduce": Command(("reproduce", "unscented_jacobian", "--runs", "1", "-o", "out"), parts),
    "reproduce in workers": Command(("reproduce", "hmm_sonar", "--runs", "2", "-o", "out"), parts, longest_wait=12.0),
}


def prepared(name: str, folder: Path) -> Path:
    """Return a new working directory for a command."""
    folder.mkdir(parents=True)
    (folder / "mine.yml").write_text(HYPER_PARAMETERS)
    writer = cv2.VideoWriter(str(folder / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (128, 96))
    noise = np.random.default_rng(0)
    for k in range(300):
        frame = noise.integers(0, 40, (96, 128, 3), np.uint8)
        frame[24:64, 16 + k % 90 : 32 + k % 90] = 255
        writer.write(frame)
    writer.release()
    places = noise.uniform(-500.0, 500.0, (4, 2)) + np.arange(150)[:, None, None] * noise.normal(0.0, 5.0, (4, 2))
    rows = [f"{k},{x},{y}" for k, scan in enumerate(places + noise.normal(0.0, 2.0, places.shape)) for x, y in scan]
    (folder / "points.csv").write_text("\n".join(["time,x,y", *rows]) + "\n")
    for arguments in COMMANDS[name].before:
        finish(arguments, folder)
    return folder


def finish(arguments: tuple[str, ...], folder: Path) -> None:
    done = subprocess.run([*PROGRAM, *arguments], cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr


def session(leader: int) -> list[int]:
    """Return the processes of a session that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def started(arguments: tuple[str, ...], folder: Path) -> subprocess.Popen[str]:
    """Start a command and wait until it handles signals."""
    process = subprocess.Popen(
        [*PROGRAM, *arguments], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
        preexec_fn=_hear_signals,
    )  # fmt: skip
    handled = 1 << (signal.SIGTERM - 1)
    while process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        if int(status.partition("SigCgt:")[2].split()[0], 16) & handled:
            break
        time.sleep(0.01)
    return process


def _hear_signals() -> None:
    """Undo what a shell does to processes in the background, and nohup to all: they ignore these signals."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def wait_for_workers(process: subprocess.Popen[str]) -> None:
    """Wait until two workers run beside the command and the two resource trackers."""
    while process.poll() is None and len(session(process.pid)) < 5:
        time.sleep(0.05)
    time.sleep(1.0)


def end(process: subprocess.Popen[str], number: int) -> str:
    """Send a signal, check that all processes end, and return the text on stderr."""
    limit = LONGEST_END * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    running = process.poll() is None
    process.send_signal(number)
    begin = time.monotonic()
    try:
        while (alive := [*session(process.pid), *([] if process.poll() is not None else [process.pid])]) and (
            time.monotonic() < begin + limit
        ):
            time.sleep(0.02)
        assert not alive, f"{len(alive)} processes are alive {limit:.0f} s after {signal.Signals(number).name}"
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)
    _, text = process.communicate()
    if running and number != signal.SIGKILL:
        # It may have ended by itself in the meantime, or be ending: then the signal has its usual effect.
        assert process.returncode in (0, 128 + number, -number), text
        ended = process.returncode in (0, -number)
        assert ended or f"stopped by {signal.Signals(number).name}" in text or "track" in process.args
    assert "Traceback" not in text
    return text


def leftovers(folder: Path) -> list[str]:
    """Return hidden and unfinished files. A folder of results keeps its lock."""
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if (path.name.startswith(".") or "unfinished" in path.name) and path.name != ".lock"
    ]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Any, float]]:
    """Content after a run that was not stopped, and the duration of that run, s."""
    known: dict[str, tuple[Any, float]] = {}

    def of(name: str) -> tuple[Any, float]:
        if name not in known:
            folder = prepared(name, tmp_path_factory.mktemp("whole") / "here")
            begin = time.monotonic()
            finish(COMMANDS[name].arguments, folder)
            known[name] = COMMANDS[name].content(folder), time.monotonic() - begin
        return known[name]

    return of


def test_a_stopped_bench_ends_its_workers_and_goes_on(tmp_path: Path) -> None:
    command, folder = COMMANDS["bench"], prepared("bench", tmp_path / "here")
    process = started(command.arguments, folder)
    wait_for_workers(process)
    text = end(process, signal.SIGTERM)
    assert not leftovers(folder)
    found = command.content(folder)
    if process.returncode:
        said = re.search(r"servotrack: stopped by SIGTERM; (\d+) of 9 cells finished; run the same command", text)
        assert said is not None and int(said[1]) == sum(len(rows) == 30 for rows in found.values()), text
    finish(command.arguments, folder)
    again = command.content(folder)
    assert all(again[path] == rows for path, rows in found.items() if len(rows) == 30) and len(again) == 9


def test_a_worker_that_is_stopped_inside_a_finalizer_ends_without_a_traceback(tmp_path: Path) -> None:
    program = """
import os, signal, time
from servotrack.baselines.running import workers
from servotrack.baselines.running.stopping import Stopped

class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)

workers._enter(os.getppid(), ".", [])
workers._worker.busy = True
one = Finalized()
try:
    del one
    time.sleep(2.0)
except Stopped:
    print("stopped", flush=True)
os._exit(0)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("stopped\n", "")


def test_workers_of_a_killed_command_end(tmp_path: Path) -> None:
    process = started(("bench", "-a", "kf,ukf", "-n", "400", "-j", "2", "-o", "out", "--no-video"), tmp_path)
    wait_for_workers(process)
    end(process, signal.SIGKILL)
    rows(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: signal.Signals(number).name)
@pytest.mark.parametrize("name", COMMANDS)
def test_signals_at_random_times(
    name: str, number: int, tmp_path: Path, reference: Callable[[str], tuple[Any, float]]
) -> None:
    command = COMMANDS[name]
    content, duration = reference(name)
    chance = random.Random(f"{name} {number}")
    attempt = 0
    folder = prepared(name, tmp_path / "0")
    begin = time.monotonic()
    for turn in range(TIMES):
        process = started(command.arguments, folder)
        time.sleep(chance.uniform(0.0, min(0.9 * duration, command.longest_wait)))
        end(process, number)
        print(
            f"{name}, {signal.Signals(number).name} {turn + 1} of {TIMES}: {time.monotonic() - begin:.0f} s", flush=True
        )
        assert not leftovers(folder)
        found = command.content(folder)
        if process.returncode in (0, -number):
            assert found == content
            shutil.rmtree(folder)
            attempt += 1
            folder = prepared(name, tmp_path / str(attempt))
    finish(command.arguments, folder)
    assert command.content(folder) == content


def test_a_signal_in_a_finalizer_stops_the_command_nevertheless(tmp_path: Path) -> None:
    code = (
        "import os, signal, time\n"
        "from servotrack.baselines.running import stopping\n"
        "class Body:\n"
        "    def __del__(self):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        for _ in range(1000): pass\n"
        "with stopping.program('files are kept'):\n"
        "    body = Body()\n    del body\n    time.sleep(30)\n"
    )
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    assert done.stderr == "servotrack: stopped by SIGTERM; files are kept\n"
    assert time.monotonic() - begin < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench", "train in workers", "reproduce in workers"])
def test_workers_of_commands_killed_at_random_times_end(name: str, tmp_path: Path) -> None:
    chance = random.Random(name)
    folder = prepared(name, tmp_path / "here")
    for _ in range(TIMES):
        process = started(COMMANDS[name].arguments, folder)
        time.sleep(chance.uniform(0.5, 8.0))
        end(process, signal.SIGKILL)
        COMMANDS[name].content(folder)


@pytest.mark.slow
@pytest.mark.parametrize(("numbers", "within"), [((signal.SIGTERM,), LONGEST_END), ((signal.SIGINT,) * 2, 3.0)])
def test_a_command_that_does_not_let_itself_be_stopped_ends_by_force(
    numbers: tuple[int, ...], within: float, tmp_path: Path
) -> None:
    code = (
        "import pathlib, signal, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from servotrack.baselines.running import stopping, unfinished\n"
        "path = pathlib.Path('half')\n"
        "with stopping.stoppable():\n"
        "    unfinished.begin(path)\n    path.touch()\n    print('ready', flush=True)\n"
        "    while True:\n        try:\n            time.sleep(60)\n        except BaseException:\n            pass\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    begin = time.monotonic()
    for number in numbers:
        process.send_signal(number)
        time.sleep(0.5)
    _, text = process.communicate(timeout=30)
    limit = within * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    assert time.monotonic() - begin < limit
    assert process.returncode == 128 + numbers[0]
    assert text == (
        f"servotrack: stopped by {signal.Signals(numbers[0]).name}, by force; finished work is kept; "
        "run the same command to go on\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.fixture
def default_handler() -> Iterator[None]:
    """Python's own handler, which processes that are started in the background do not have."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL), signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGTERM, before[0])
    signal.signal(signal.SIGINT, before[1])


@pytest.mark.usefixtures("default_handler")
def test_a_closed_terminal_sends_several_signals_and_only_the_first_counts() -> None:
    with Interruption() as interruption:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGTERM):
            os.kill(os.getpid(), number)
    assert interruption.signal == signal.SIGTERM


@pytest.mark.usefixtures("default_handler")
def test_a_second_interrupt_acts_as_usual() -> None:
    with pytest.raises(KeyboardInterrupt), Interruption():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)


@pytest.mark.usefixtures("default_handler")
def test_ignored_signals_stay_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
        assert interruption.signal == 0
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("default_handler")
def test_steps_that_belong_together_are_finished_first() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), undisturbed():
        os.kill(os.getpid(), signal.SIGINT)
        done.append(1)
    assert done == [1]


def test_the_innermost_context_says_what_is_kept() -> None:
    with (
        pytest.raises(Stopped, match="stopped by SIGTERM; 2 of 3 cells"),
        keeping(lambda: "all"),
        keeping(lambda: "2 of 3 cells"),
    ):
        raise Stopped(signal.SIGTERM)


def test_a_signal_in_a_compiled_function_is_a_stop_too() -> None:
    with pytest.raises(Stopped, match="stopped by SIGHUP; 1 of 2"), keeping(lambda: "1 of 2"):
        try:
            raise Stopped(signal.SIGHUP)
        except Stopped as stop:
            raise SystemError("a function returned a result with an exception set") from stop
    with pytest.raises(ValueError, match="mistake"), keeping(lambda: "1 of 2"):
        raise ValueError("mistake")


def test_errors_that_cause_each_other_end() -> None:
    first, second = ValueError("first"), ValueError("second")
    first.__cause__, second.__cause__ = second, first
    with pytest.raises(ValueError, match="first"), keeping(lambda: "1 of 2"):
        raise first


def test_unfinished_files_are_removed_or_kept(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("half", "whole", "folder/page", "done"):
        (tmp_path / name).write_text(name)
    unfinished.begin(tmp_path / "half")
    unfinished.begin(tmp_path / "never made")
    unfinished.begin(tmp_path / "whole", keep_as=tmp_path / "tracks.txt")
    unfinished.begin(tmp_path / "folder")
    unfinished.begin(tmp_path / "done")
    unfinished.end(tmp_path / "done")
    unfinished.clear()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"done": "done", "tracks.txt": "whole"}
