"""Modules that lie in the working directory are imported by no command, unless the user names one of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from servotrack._import_path import append_working_directory, leave_working_directory

SHADOWED = (
    "yaml", "joblib", "scipy", "queue", "numpy", "gymnasium", "cloudpickle", "typer", "rich", "matplotlib", "numba",
    "cv2", "pymunk", "onnxruntime", "defusedxml", "torch", "stable_baselines3",
    "tomllib", "csv", "difflib", "statistics",
)  # fmt: skip
SHORT = ("--set", "horizon=80", "-n", "2")
COMMANDS = {
    "evaluate": ("evaluate", "UncalibServo-v0", "kf", *SHORT),
    "bench": ("bench", "-a", "kf,random", "-l", "0,1", *SHORT, "-j", "2", "-o", "out"),
    "leaderboard": ("leaderboard", "out"),
    "track": ("track", "walk.avi", "--background", "0"),
    "render": ("render", "scene", "--set", "horizon=5"),
    "train": ("train", "UncalibServo-v0", "--steps", "4096", "-j", "2", "--seeds", "0-1", "--set", "horizon=80"),
    "tune": ("tune", "kf", "-n", "1"),
    "reproduce": ("reproduce", "hmm_sonar", "--runs", "1"),
    "play": ("play", "--agent", "kf", "--set", "horizon=5", "--video", "film.webm"),
    "agents": ("agents",),
}
QUICK = (("evaluate", "module"),)
CALLS = {
    "script": [str(Path(sys.executable).with_name("servotrack"))],
    # The name of the package itself is looked up by Python, before any code of ours runs.
    "module": [sys.executable, "-m", "servotrack"],
}


def hostile(folder: Path, *, package: bool) -> Path:
    """Fill a folder with modules that leave a mark when they are imported; return the folder of the marks."""
    marks = folder.parent / f"{folder.name}-marks"
    marks.mkdir()
    code = f"import os\nopen(os.path.join({str(marks)!r}, __name__), 'w').close()\nraise ImportError('hostile')\n"
    for name in SHADOWED:
        (folder / f"{name}.py").write_text(code)
    if package:
        (folder / "servotrack").mkdir()
        (folder / "servotrack" / "__init__.py").write_text(code)
    return marks


def run(call: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    return subprocess.run(
        [*CALLS[call], *arguments], cwd=cwd, env={**environment, "SDL_VIDEODRIVER": "dummy"}, capture_output=True,
        text=True, timeout=600, check=False,
    )  # fmt: skip


def write_video(path: Path) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(6):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()


@pytest.mark.parametrize(
    ("name", "call"),
    [
        (name, call) if (name, call) in QUICK else pytest.param(name, call, marks=pytest.mark.slow)
        for name in COMMANDS
        for call in CALLS
    ],
)
def test_no_command_imports_from_the_working_directory(name: str, call: str, tmp_path: Path) -> None:
    here = tmp_path / "here"
    here.mkdir()
    write_video(here / "walk.avi")
    if name == "leaderboard":
        assert run(call, *COMMANDS["bench"], cwd=here).returncode == 0
    marks = hostile(here, package=call == "script")
    done = run(call, *COMMANDS[name], cwd=here)
    assert done.returncode == 0, done.stderr
    assert not [mark.name for mark in marks.iterdir()]


def test_a_named_module_is_found_in_workers_too(tmp_path: Path) -> None:
    here = tmp_path / "here"
    here.mkdir()
    marks = hostile(here, package=True)
    (here / "mine.py").write_text(
        '"""Mine."""\nimport numpy as np\n\n\nclass Still:\n    """Does nothing."""\n\n'
        "    def __init__(self, env):\n        pass\n\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros_like(observation['joint_angles'], dtype=np.float32), None\n"
    )
    arguments = ("bench", "-a", "mine:Still,random", "-l", "0,1", *SHORT, "-j", "2", "-o", "out", "--no-video")
    done = run("script", *arguments, cwd=here)
    assert done.returncode == 0, done.stderr
    assert "mine:Still" in done.stdout and not list(marks.iterdir())


@pytest.mark.parametrize(
    ("before", "run_as", "removed"),
    [
        (["python", "-m", "servotrack", "bench"], ["-m", "bench"], True),
        (["python", "-X", "dev", "-mservotrack.baselines.speed"], ["-m"], True),
        (["python", "-m", "mypackage.servotrack", "servotrack"], ["-m", "servotrack"], False),
        (["python", "mine.py", "-m", "servotrack"], ["mine.py", "-m", "servotrack"], False),
        (["python", "-c", "pass"], ["-c"], False),
    ],
)
def test_only_the_entry_of_the_own_command_line_is_removed(
    before: list[str], run_as: list[str], removed: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "orig_argv", before)
    monkeypatch.setattr(sys, "argv", run_as)
    monkeypatch.setattr(sys, "path", [str(tmp_path), "/elsewhere"])
    leave_working_directory()
    assert sys.path == (["/elsewhere"] if removed else [str(tmp_path), "/elsewhere"])
    append_working_directory()
    append_working_directory()
    assert sys.path == (["/elsewhere", str(tmp_path)] if removed else [str(tmp_path), "/elsewhere"])
