"""Programs that speak messages: the examples in three languages, and what goes wrong with others."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_cases import EXAMPLES, judged, program, submitted, write_suite

from servotrack.baselines.board import message_agent, sandbox
from servotrack.baselines.board.message_agent import MessageError
from servotrack.baselines.board.replay import Episode, ReplayError, replayed
from servotrack.baselines.board.sandbox import bubblewrap, confined
from servotrack.baselines.board.submission import read_submission
from servotrack.baselines.board.submit import command_candidate
from servotrack.baselines.board.suites import behavior_of, load_suite

LOOP = "import json, sys\nfor line in sys.stdin:\n    m = json.loads(line)\n    if 'observation' not in m: continue\n"
STILL = LOOP + "    print([0.0, 0.0], flush=True)\n"
needs_bubblewrap = pytest.mark.skipif(bubblewrap() is None, reason="bubblewrap makes no namespaces here")


def test_the_examples_give_the_same_actions_in_three_languages(tmp_path: Path, suite: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    commands = {"py": "python agent.py"}
    if shutil.which("node"):
        commands["js"] = "node agent.js"
    if shutil.which("cc"):
        source = str(EXAMPLES / "agent.c")
        subprocess.run(["cc", "-O2", "-ffp-contract=off", "-o", "agent", source], check=True, timeout=60)
        commands["c"] = "./agent"
    for language in commands.keys() - {"c"}:
        shutil.copy(EXAMPLES / f"agent.{language}", tmp_path)
    frozen = load_suite(str(suite))
    played = {}
    for language, command in commands.items():
        folder = submitted(tmp_path / "out" / language, frozen, command_candidate(command, f"my-{language}", "tests"))
        submission = read_submission(folder, frozen)
        played[language] = [episode.points for episode in submission.cells[0].episodes("public")]
        assert (judged(folder, suite).badge, submission.information) == ("replayed", "undeclared")
    for points in played.values():
        assert all(np.array_equal(a, b) for a, b in zip(points, played["py"], strict=True))


def clutter_suite(folder: Path, **kwargs: Any) -> Path:
    """Write a suite of one cell with points in clutter."""
    behavior = behavior_of("ClutterTracking-v0", kwargs)
    fields = {"env_id": "ClutterTracking-v0", "env_kwargs": kwargs, "anchors": [100.0, 1.0], "behavior": behavior}
    return write_suite(folder, **fields)


def test_an_observer_of_points_answers_by_rows(tmp_path: Path) -> None:
    suite = clutter_suite(tmp_path, level=4, horizon=25)
    text = (EXAMPLES / "observer.py").read_text(encoding="utf-8")
    folder = submitted(tmp_path / "out", suite, program(tmp_path / "observer.py", text))
    assert judged(folder, suite).badge == "replayed"
    submission = read_submission(folder, load_suite(str(suite)))
    assert submission.cells[0].cell.scores(submission.cells[0].rows["public"]).min() > 0.1
    # Episodes that never end are compared without being stepped or held.
    endless = [Episode(episode.seed, np.resize(episode.points, (20_000, episode.points.shape[1])))
               for episode in submission.cells[0].episodes()]  # fmt: skip
    rows = replayed(submission.suite, submission.cells[0].cell, endless)
    assert all(isinstance(row, ReplayError) and "ends after 25 steps" in str(row) for row in rows)


@pytest.mark.parametrize(
    "answer",
    ["[0.9, 1.0, 2.0]", "[[0.9, 1.0]]", "[[[0.9, 1.0, 2.0]]]", "[[0.9, 1.0, true]]", "[[]]", str([[0, 0, 0]] * 97)],
)
def test_rows_of_an_answer_are_checked(tmp_path: Path, answer: str) -> None:
    suite = clutter_suite(tmp_path, level=1, horizon=5)
    with pytest.raises(MessageError, match="an action is at most 96 rows, each a list of 3 numbers"):
        submitted(
            tmp_path / "out", suite, program(tmp_path / "agent.py", LOOP + f"    print('{answer}', flush=True)\n")
        )


@needs_bubblewrap
def test_python_may_be_installed_under_tmp(monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as place:
        path = Path(place) / "python"
        path.write_text("here")
        for visible, code in (([place], 0), ([], 1)):
            monkeypatch.setattr(sandbox, "_visible", lambda added=visible: [*sandbox._SYSTEM, *added])
            done = subprocess.run(confined(["/bin/cat", str(path)], {}, "/tmp"), capture_output=True, check=False)
            assert (done.returncode, done.stdout) == (code, b"" if code else b"here")


@needs_bubblewrap
def test_programs_run_again_in_a_namespace(tmp_path: Path, suite: Path) -> None:
    folder = submitted(tmp_path / "out", suite, program(tmp_path / "agent.py", STILL))
    verdict = judged(folder, suite, run=True, program=True, nonce="1", fresh=2)
    assert verdict.badge == "re-run"
    assert next(iter(verdict.cells.values())).fresh is not None


FORBIDDEN = [
    "import socket; socket.create_connection(('127.0.0.1', 9), 2)",
    "import socket; socket.getaddrinfo('localhost.example', 80)",
    f"open({__file__!r})",
    "open('/etc/passwd')",
    "open('note', 'w')",
    "open('/usr/note', 'w')",
    "import os; os.kill(os.getppid() if os.getppid() > 1 else 10**6, 0)",
    "b = bytearray(5_000_000_000)",
    "open('/tmp/large', 'wb').write(bytes(2_000_000))",
]


@needs_bubblewrap
def test_a_namespace_has_no_network_no_files_and_little_memory(tmp_path: Path, suite: Path) -> None:
    # Outside, where it is submitted, the program stays still. Inside it says what it could do by another action.
    text = f"""
import os
allowed = []
for attempt in {FORBIDDEN!r} if os.getcwd() == "/agent" else []:
    try:
        exec(attempt)
        allowed.append(attempt)
    except BaseException:
        pass
if allowed:
    raise SystemExit(str(allowed))
"""
    folder = submitted(tmp_path / "out", suite, program(tmp_path / "agent.py", text + STILL))
    verdict = judged(folder, suite, run=True, program=True)
    assert verdict.badge == "re-run", verdict.notes
    free = f"import os\nif os.getcwd() == '/agent': raise SystemExit('inside')\n{STILL}"
    folder = submitted(tmp_path / "other", suite, program(tmp_path / "agent.py", free))
    verdict = judged(folder, suite, run=True, program=True)
    assert "wrote to stderr: inside" in verdict.notes[0]
    assert verdict.badge == "replayed"


def test_an_agent_that_recognizes_its_seeds_is_noticed(tmp_path: Path, suite: Path) -> None:
    from servotrack.baselines.board.verification import CellVerdict, Verdict, _judge_fresh

    folder = submitted(tmp_path / "out", suite)
    submission = read_submission(folder, load_suite(str(suite)))
    name = submission.cells[0].cell.name
    scores = submission.cells[0].cell.scores([row for rows in submission.cells[0].rows.values() for row in rows])
    error = float(scores.std() / np.sqrt(len(scores)))
    for gap, suspicious in ((3.0, False), (8.0, True)):
        fresh = (float(scores.mean()) - gap * error, error)
        verdict = Verdict("kf", cells={name: CellVerdict("equal", fresh=fresh)})
        _judge_fresh(submission, verdict)
        assert bool(verdict.notes) == suspicious


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the agent ended .*exit code 0"),
        ("import sys; sys.exit('no model found')", "the agent ended .*exit code 1; it wrote to stderr: no model found"),
        (LOOP + "    print('[0.0', flush=True)", "answered '\\[0.0'"),
        (LOOP + "    print('[0.0, NaN]', flush=True)", "NaN is not a number of JSON"),
        (LOOP + "    print('[0.0, 1e999]', flush=True)", "too large for a number"),
        (LOOP + "    print('[0.0]', flush=True)", "an action is a list of 2 numbers"),
        (LOOP + "    print('[true, false]', flush=True)", "an action is a list of 2 numbers"),
        (LOOP + "    print('{}', flush=True)", "an action is a list of 2 numbers"),
        (LOOP + "    print('\\x1b[31m', flush=True)", "answered '"),
        (LOOP + "    print('[' * 10**5, flush=True)", "more than 65536 bytes"),
        (LOOP + "    print([0.0, 0.0], end='', flush=True); sys.exit()", "without end"),
        (LOOP + "    sys.stdout.buffer.write(b'\\xff\\n'); sys.stdout.flush()", "answered '"),
        (LOOP + "    print([0.0, 0.0], flush=True); sys.exit(3)", "step 1.*exit code 3"),
    ],
)
def test_failures_name_cell_episode_and_step(tmp_path: Path, suite: Path, text: str, message: str) -> None:
    with pytest.raises(MessageError, match=message) as caught:
        submitted(tmp_path / "out", suite, program(tmp_path / "agent.py", text))
    assert "UncalibServo-v0,horizon=66,level=3, episode 0" in str(caught.value)
    assert str(caught.value).isprintable()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent.py"]


def test_silence_ends(tmp_path: Path, suite: Path, monkeypatch) -> None:
    monkeypatch.setattr(message_agent, "STARTING", 0.5)
    begin = time.monotonic()
    with pytest.raises(MessageError, match=r"no answer within 0\.5 s; write one line per message and flush stdout"):
        submitted(tmp_path / "out", suite, program(tmp_path / "agent.py", LOOP + "    pass\n"))
    assert time.monotonic() - begin < 20.0


def test_commands_must_have_files(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"must name a file of the agent, got 'python agent\.py'"):
        command_candidate("python agent.py", "x", "")
    with pytest.raises(ValueError, match="must name a program"):
        command_candidate(" ", "x", "")
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "agent.py").write_text(folder)
    with pytest.raises(ValueError, match="different names"):
        command_candidate("python a/agent.py", "x", "", [Path("b/agent.py")])
    assert command_candidate("python a/agent.py", "x", "").entry == ["python", "./agent.py"]
