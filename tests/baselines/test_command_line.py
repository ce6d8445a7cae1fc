"""The command line, run as a user runs it."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import servotrack as package
from servotrack.baselines.evaluation.watch import key_action

MISTAKES = [
    (["evaluate", "UncalibServo-v0", "kff"], "did you mean 'kf'"),
    (["evaluate", "UncalibServ-v0", "kf"], "UncalibServ"),
    (["evaluate", "UncalibServo-v0", "kf", "--set", "pixel_nois=2"], "did you mean 'pixel_noise'"),
    (["evaluate", "UncalibServo-v0", "kf", "--set", "pixel_noise"], "--set takes KEY=VALUE, got 'pixel_noise'"),
    (["evaluate", "UncalibServo-v0", "kf", "-l", "2", "--set", "level=3"], "level is given twice"),
    (["evaluate", "UncalibServo-v0", "kf", "-l", "9"], "level must be a whole number from 0 to 6, got 9"),
    (["evaluate", "UncalibServo-v0", "kf", "--split", "exam"], "split must be one of train, tune, test, got 'exam'"),
    (["bench", "-a", "zebra"], "no agent is called 'zebra'"),
    (["bench", "-l", "5-9"], "level must be a whole number from 0 to 6, got 7"),
    (["bench", "-l", "low"], "levels must look like 0-5 or 0,3, got 'low'"),
    (["leaderboard", "nowhere"], "nowhere holds no results"),
    (["reproduce", "chess"], "paper must be one of gm_phd_video, gm_phd_video_readings, monte_carlo_color, "),
    (["reproduce", "hmm-soner", "--truth", "gt.txt"], "got 'hmm-soner'; did you mean 'hmm_sonar'?"),
    (["play", "--video", "film.webm"], "needs an agent"),
    (["play", "--agent", "kf", "--video", "film.mov"], "video must end in .webm"),
]


def servotrack(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SDL_VIDEODRIVER": "dummy", "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-m", "servotrack", *arguments],
        cwd=cwd, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_explained_in_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from servotrack.__main__ import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["servotrack", *arguments])
    monkeypatch.setattr(sys, "path", sys.path[:])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_no_bar_is_shown_before_a_name_is_refused(tmp_path: Path) -> None:
    for arguments in (
        ["evaluate", "UncalibServo-v0", "kff"],
        ["evaluate", "UncalibServo-v9", "kf"],
        ["bench", "-a", "x"],
    ):
        run = servotrack(*arguments, cwd=tmp_path)
        assert run.returncode == 2
        assert run.stdout == ""
        assert len(run.stderr.splitlines()) == 1, run.stderr
    assert not list(tmp_path.iterdir())


def test_version_and_help_have_their_usual_options(tmp_path: Path) -> None:
    assert servotrack("--version", cwd=tmp_path).stdout == f"servotrack {package.__version__}\n"
    for arguments in (["-h"], ["bench", "-h"], ["track", "-h"]):
        assert "Usage:" in servotrack(*arguments, cwd=tmp_path).stdout
    assert "--install-completion" in servotrack("--help", cwd=tmp_path).stdout


def test_tables_for_programs_stand_alone_on_stdout(tmp_path: Path) -> None:
    arguments = ["evaluate", "ClutterTracking-v0", "gnn", "--set", "horizon=10", "-n", "2"]
    run = servotrack(*arguments, "--format", "json", cwd=tmp_path)
    rows = json.loads(run.stdout)["ClutterTracking-v0,horizon=10"]
    assert [row["agent"] for row in rows] == ["gnn"]
    assert float(rows[0]["OSPA(2) m"].split()[0]) > 0.0
    assert "gnn" in run.stderr and "need gm-phd" in run.stderr
    table = list(csv.DictReader(io.StringIO(servotrack(*arguments, "--format", "csv", cwd=tmp_path).stdout)))
    assert table[0]["OSPA(2) m"] == rows[0]["OSPA(2) m"]


def test_a_second_world_leaves_the_page_of_the_first(tmp_path: Path) -> None:
    for world, agents in (("UncalibServo-v0", "kf,random,oracle"), ("ClutterTracking-v0", "gnn,gm-phd")):
        run = servotrack(
            "bench", "--env", world, "-a", agents, "-l", "2", "-n", "2", "-j", "1", "--no-video", cwd=tmp_path
        )
        assert run.returncode == 0, run.stderr
    bench = tmp_path / "results" / "bench"
    assert "random" in (bench / "UncalibServo-v0" / "leaderboard.md").read_text(encoding="utf-8")
    assert "gm-phd" in (bench / "ClutterTracking-v0" / "leaderboard.md").read_text(encoding="utf-8")
    index = (bench / "index.html").read_text(encoding="utf-8")
    assert "UncalibServo-v0/leaderboard.html" in index and "ClutterTracking-v0/leaderboard.html" in index


def test_evaluate_shows_agents_beside_each_other(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        '"""Mine."""\nimport numpy as np\n\n\nclass Still:\n    """Does nothing."""\n\n'
        "    def __init__(self, env):\n        pass\n\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros_like(observation['joint_angles'], dtype=np.float32), None\n"
    )
    common = ("UncalibServo-v0", "-l", "1", "-n", "3", "--split", "tune", "-o", "out")
    for agent in ("kf+one-step", "mine:Still"):
        env_id, *options = common
        done = servotrack("evaluate", env_id, agent, *options, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert "kf+one-step" in done.stdout and "mine:Still" in done.stdout and "undeclared" in done.stdout


def test_the_main_job_writes_what_it_promises(tmp_path: Path) -> None:
    arguments = ("bench", "-a", "random,ukf,lifted-kf,oracle", "-l", "1,3", "-n", "4", "--split", "tune", "-j", "1")
    first = servotrack(*arguments, "-o", "out", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert {path.name for path in (tmp_path / "out").glob("[!.]*") if path.is_file()} == {
        "leaderboard.md", "leaderboard.html", "levels.png", "levels.svg", "levels.pdf", "best.webm",
    }  # fmt: skip
    assert "lifted-kf" in first.stdout and "oracle †" in first.stdout
    assert "Traceback" not in first.stderr and "OpenCV" not in first.stderr

    report = servotrack("leaderboard", "out", "--output", "elsewhere", "--details", cwd=tmp_path)
    assert report.returncode == 0, report.stderr
    assert "UncalibServo-v0,level=3" in report.stdout
    assert (tmp_path / "elsewhere" / "leaderboard.md").exists()


def test_play_shows_an_agent_in_a_window(tmp_path: Path) -> None:
    pytest.importorskip("pygame")
    done = servotrack("play", "--agent", "kf", "-l", "0", "--set", "horizon=5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_arrow_keys_turn_one_joint_each() -> None:
    assert key_action(frozenset(), 2).tolist() == [0.0, 0.0]
    assert key_action(frozenset({"left", "up"}), 3).tolist() == [-0.5, 0.5, 0.0]
    assert np.array_equal(key_action(frozenset({"left", "right"}), 2), np.zeros(2))


def test_the_command_line_is_quick_to_ask_for_help(tmp_path: Path) -> None:
    code = (
        "import sys; sys.argv = ['servotrack', '--help']\n"
        "import servotrack.__main__ as m\n"
        "heavy = {'torch', 'stable_baselines3', 'matplotlib', 'numba', 'cv2', 'scipy', 'joblib', 'pygame'}\n"
        "try:\n    m.main()\nexcept SystemExit:\n    pass\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_settings_take_true_and_false_as_a_shell_writes_them() -> None:
    from servotrack.commands.terms import env_kwargs

    assert env_kwargs(3, ["stamped=false", "latency=2", "target=point"]) == {
        "level": 3,
        "stamped": False,
        "latency": 2,
        "target": "point",
    }


def test_full_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from servotrack.__main__ import main

    def fail(*_: object) -> None:
        raise MemoryError("Unable to allocate 8.00 TiB")

    monkeypatch.setattr("servotrack.baselines.track_command.points_command.read_points", fail)
    monkeypatch.setattr("sys.argv", ["servotrack", "track", "points.csv"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    text = capsys.readouterr().err
    assert (
        text.startswith("servotrack: memory is full (Unable to allocate 8.00 TiB); free some")
        and "Traceback" not in text
    )
