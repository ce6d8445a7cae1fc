"""The README's examples run as they stand there, and their results are what the text says."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.files import ResultsError

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
TEXT = README.read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = [
    line.split("#")[0].strip().removeprefix(".venv/bin/")
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if "servotrack " in line and not line.startswith("pip")
]


def _number(output: str, pattern: str) -> float:
    found = re.search(pattern, output)
    assert found, f"no {pattern!r} in {output!r}"
    return float(found[1])


def _servos(output: str) -> bool:
    return _number(output, r"([\d.]+) px from the goal") < 1.0


def _follows(output: str) -> bool:
    return _number(output, r"([\d.]+) mm from the target") < 10.0


def _tracks(output: str) -> bool:
    # Two targets, at (190, 0) and (0, 152), each with one identity, and a count of two.
    numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*", output)]
    labels, states, count = numbers[:2], numbers[2:-1], numbers[-1]
    at = sorted((states[0], states[2]) for states in (states[:4], states[4:]))
    near = abs(at[0][1] - 152.0) < 3.0 and abs(at[1][0] - 190.0) < 3.0
    return len(set(labels)) == 2 and len(states) == 8 and near and abs(count - 2.0) < 0.2


def _beats_random(output: str) -> bool:
    ours, random = (_number(output, rf"{name} ([\d.]+)") for name in ("readme_agent:make", "random"))
    return ours >= random + 0.4


RESULTS: list[Callable[[str], bool]] = [_servos, _follows, _tracks, _beats_random]


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_example_does_what_the_text_says(number: int, tmp_path: Path) -> None:
    script = tmp_path / "readme_agent.py"
    script.write_text(EXAMPLES[number], encoding="utf-8")
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    # On a machine where no test has run yet, kernels are compiled.
    assert not [line for line in run.stderr.splitlines() if "compiling kernels" not in line]
    assert RESULTS[number](run.stdout), run.stdout


def test_every_example_has_a_result() -> None:
    assert len(EXAMPLES) == len(RESULTS)


def test_the_agent_takes_part_in_the_benchmark(tmp_path: Path) -> None:
    (tmp_path / "readme_agent.py").write_text(EXAMPLES[-1], encoding="utf-8")
    command = next(line for line in re.findall(r"`(servotrack bench --agents readme_agent[^`]*)`", TEXT))
    run = subprocess.run(
        [sys.executable, "-m", *shlex.split(command), "--levels", "2", "-n", "4", "--no-video", "--jobs", "1"],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    order = [run.stdout.index(name) for name in ("oracle", "kf", "readme_agent:make", "random")]
    assert order == sorted(order), run.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_name_options_that_exist(command: str) -> None:
    words = shlex.split(command)
    run = subprocess.run(
        [sys.executable, "-m", "servotrack", words[1], "--help"], capture_output=True, text=True, check=True,
        env={"PATH": "", "COLUMNS": "200", "TERM": "dumb"},
    )  # fmt: skip
    for option in [word for word in words if word.startswith("--")]:
        assert option in run.stdout, f"{command}: {option} is not an option of {words[1]}"


def test_table_and_figure_are_of_the_same_results() -> None:
    stamp = re.search(r"<!-- results (\w{12}) -->", TEXT)
    assert stamp, "the leaderboard has no stamp; write it with `servotrack leaderboard FOLDER --into README.md`"
    picture = (ROOT / "docs" / "images" / "levels.png").read_bytes()
    assert f"results {stamp[1]}".encode() in picture, "table and figure are of different results"
    assert cv2.imread(str(ROOT / "docs" / "images" / "levels.png")) is not None


def test_embed_replaces_only_what_stands_between_the_marks(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- a:begin -->\nold\n<!-- a:end -->\nafter\n", encoding="utf-8")
    embed("new", document, "a")
    embed("newer", document, "a")
    assert document.read_text(encoding="utf-8") == "before\n<!-- a:begin -->\nnewer\n<!-- a:end -->\nafter\n"


def test_embed_refuses_a_document_without_marks(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("nothing", encoding="utf-8")
    with pytest.raises(ResultsError, match="a:begin"):
        embed("new", document, "a")
    assert document.read_text(encoding="utf-8") == "nothing"
