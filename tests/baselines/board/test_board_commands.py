"""`servotrack submit` and `servotrack verify` on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servotrack.__main__ import app
from servotrack.baselines.board import verify as verification
from servotrack.baselines.board.verify import read_verdicts


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Function that runs a command line in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def test_submit_then_verify(run, tmp_path: Path, suite: Path) -> None:
    made = run("submit", "kf+pi", "--suite", suite, "--authors", "Ada")
    assert made.exit_code == 0, made.output
    folder = tmp_path / "leaderboard" / "tiny" / "kf+pi"
    assert json.loads((folder / "card.json").read_bytes())["claims"]["authors"] == "Ada"
    found = run("verify", folder.parent, "--suite", suite, "--agent", "--fresh", "2", "-o", "v.json", "--format", "csv")
    assert found.exit_code == 0, found.output
    assert "kf+pi,re-run,1/1" in found.output
    (verdict,) = read_verdicts(tmp_path / "v.json").values()
    assert (verdict.name, verdict.badge, verdict.suite) == ("kf+pi", "re-run", "tiny")
    trace = next(folder.glob("traces/*"))
    trace.write_bytes(trace.read_bytes() + b"x")
    found = run("verify", folder, "--suite", suite)
    assert found.exit_code == 1
    assert "kf+pi is refused" in found.output
    assert "SHA-256" in found.output


def test_mistakes_are_named(run, tmp_path: Path, suite: Path) -> None:
    for words, message in (
        (("submit",), "give either an agent or --command"),
        (("submit", "kf", "--command", "./x"), "give either an agent or --command"),
        (("submit", "--command", "./x"), "--name must be given"),
        (("submit", "kff"), "did you mean 'kf'"),
        (("submit", "my.module:agent"), "submit agents of your own as ONNX or by --command"),
        (("submit", "kf", "--suite", "2019"), "no suite is called '2019'; known are 2027a"),
        (("submit", "kf", "--cell", "UncalibServo-v0,level=8"), "has no cell"),
        (("submit", "eyes"), "was made for UncalibServoPixels-v0,level=3, not in 2027a"),
        (("submit", "nothing.onnx"), "nothing.json cannot be read"),
        (("verify", "nothing", "--suite", "2019"), "no suite is called '2019'"),
    ):
        found = run(*words)
        assert found.exit_code != 0
        assert message in str(found.exception), found.exception
    assert not list(tmp_path.iterdir())


def test_verify_names_what_is_no_submission(run, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    found = run("verify", "empty", "missing")
    assert found.exit_code == 1
    assert "empty is refused" in found.output
    assert "missing is refused" in found.output


def test_files_of_verdicts_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "verdicts.json"
    verification.write_verdicts([], path)
    assert read_verdicts(path) == {}
    path.write_text(path.read_text().replace("[", '[{"badge": "gold"}').replace("\n  \n", "\n"))
    with pytest.raises(verification.ResultsError, match=r"verdicts\.json is corrupt .*folder is missing"):
        read_verdicts(path)
