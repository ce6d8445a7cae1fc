"""Output on terminals of every kind: markup in names, missing symbols, readers that leave, widths."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.reporting.grid import Grid, as_markdown, as_sections
from servotrack.baselines.reporting.plain_text import encodable, markdown_code, markdown_text, printable
from servotrack.baselines.reporting.terminal import CLOSED_PIPE, Format, PlainConsole, Screen, print_tables

HOSTILE = [
    "[red]x[/red]", "[/]", ":warning:", "a\x1b[31mb", "c\u202ed", "<b>e</b>", "f|g", "`h`", "[i](http://j)", "*k* _l_",
    "![m](http://n)", "&lt;", "\\", "o\r", "[link=http://p]q",
]  # fmt: skip
NUMBERS = ["0.98 [0.97, 0.99]", "12.1 ≥ ±", "−3 × bound", "4 µs"]


def grid(names: list[str]) -> Grid:
    return Grid(["agent", "information", "score", "steady mm", "× bound", "time"],
                [[name, "model-free", *NUMBERS] for name in names], 2)  # fmt: skip


def printed(names: list[str], width: int = 200, encoding: str = "utf-8") -> str:
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding, newline="\n")
    print_tables(PlainConsole(file=stream, width=width), {"Title · [bold]": grid(names)})
    stream.flush()
    return stream.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]


def test_names_are_printed_as_they_are() -> None:
    text = printed(HOSTILE)
    for name in HOSTILE:
        shown = name.replace("\x1b", "\\x1b").replace("\u202e", "\\u202e").replace("\r", "\\r")
        assert f"│{shown} " in text
    assert "Title · [bold]" in text and "\x1b" not in text and "\u202e" not in text


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1", "utf-8", "cp437"])
def test_symbols_that_an_encoding_lacks_keep_their_columns(encoding: str) -> None:
    lines = [line for line in printed(["kf †", "ü"], encoding=encoding).splitlines()[1:] if line]
    assert len({cell_len(line) for line in lines}) == 1
    text = "\n".join(lines)
    assert ("kf +" in text) == (encoding in ("ascii", "latin-1", "cp437"))
    assert ("12.1 >= +-" in text) == (encoding == "ascii")
    assert "?" not in text


@given(st.text())
@settings(max_examples=200, deadline=None)
def test_any_text_can_be_printed_anywhere(text: str) -> None:
    for encoding in ("ascii", "cp1252", "utf-8"):
        shown = encodable(printable(text), encoding)
        assert shown.encode(encoding).decode(encoding) == shown
        assert shown.replace("\n", "").replace("\t", "").isprintable() or not shown.isascii()


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_no_word_is_cut_at_any_width(width: int) -> None:
    text = printed(["lifted-kf †", "ukf"], width)
    assert max(map(cell_len, text.splitlines())) <= width
    for word in ("lifted-kf †", "information", "model-free", "0.98", "[0.97,", "0.99]", "steady", "bound"):
        assert word in text
    assert "…" not in text


@pytest.mark.parametrize("name", HOSTILE)
def test_markdown_shows_names_as_they_are(name: str) -> None:
    lines = as_markdown(grid([name, "plain"])).splitlines()
    assert len(lines) == 4
    unescaped = [line.replace("\\\\", "").count("|") - line.replace("\\\\", "").count("\\|") for line in lines]
    assert len(set(unescaped)) == 1, "a name made a column"
    shown = markdown_text(name)
    assert shown in lines[2]
    for opening in ("<b", "</", "](", "!["):
        assert opening not in shown.replace("\\[", "").replace("\\]", "")
    assert markdown_text("&lt; &#60; a & b") == "&amp;lt; &amp;#60; a & b"
    assert "0.98 [0.97, 0.99]" in lines[2], "numbers are written as ever"
    assert as_sections({name: grid([])}, "##").splitlines()[0] == f"## {shown}"


def test_a_command_with_backticks_is_one_code_span() -> None:
    assert markdown_code("servotrack bench") == "`servotrack bench`"
    assert markdown_code("a `b` ``c") == "```a `b` ``c```"
    assert markdown_code("`a") == "`` `a ``"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three agents in one level; the name of one is markup."""
    folder = tmp_path_factory.mktemp("results")
    for agent, error in (("random", 0.5), ("oracle", 0.001), ("[red]x[/red] <i>", 0.01)):
        rows = [
            {"seed": seed, "return": -error, "length": 9, "steady": error * (1.0 + 0.01 * (seed % 7)), "success": True}
            for seed in range(200_000, 200_010)
        ]
        requires = ["truth"] if agent == "oracle" else []
        card = {"summary": "", "information": "model-free", "requires": requires, "tuning_steps": 0}
        ResultsFolder(folder).save(
            CellResults("UncalibServo-v0", {"level": 0}, agent, card, 9, rows, provenance=provenance())
        )
    return folder


def run(command: str, results: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a pipeline of bash; its exit code is that of the last program that failed."""
    line = f"set -o pipefail; {command}"
    return subprocess.run(
        ["bash", "-c", line.format(servotrack=f"{sys.executable} -m servotrack", results=results)],
        capture_output=True, check=False, env={**os.environ, **environment},
    )  # fmt: skip


def test_a_reader_that_leaves_costs_no_file_and_no_traceback(results: Path, tmp_path: Path) -> None:
    done = run(f"{{servotrack}} leaderboard {{results}} --output {tmp_path} | head -n 1", results)
    assert done.returncode == CLOSED_PIPE and done.stderr == b""
    assert done.stdout.count(b"\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        "leaderboard.md", "leaderboard.html", "levels.png", "levels.svg", "levels.pdf",
    }  # fmt: skip
    page, document = (tmp_path / "leaderboard.html").read_text(), (tmp_path / "leaderboard.md").read_text()
    assert "[red]x[/red] &lt;i&gt;" in page and "<i>" not in page
    assert r"\[red\]x\[/red\] &lt;i>" in document and "<i>" not in document


def test_a_closed_or_ascii_stdout_does_not_fail_a_command(results: Path, tmp_path: Path) -> None:
    closed = run("{servotrack} agents --format json >&-", results)
    assert (closed.returncode, closed.stderr) == (0, b"")
    command = f"{{servotrack}} leaderboard {{results}} --output {tmp_path}"
    plain = run(command, results, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (plain.returncode, plain.stderr) == (0, b"")
    assert b"[red]x[/red] <i>" in plain.stdout and plain.stdout.isascii()


def test_json_stays_exact_on_an_ascii_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    print_tables(Screen(Format.json), {"·": grid(["ü †"])})
    assert json.loads(stream.buffer.getvalue())["·"][0]["agent"] == "ü †"  # type: ignore[attr-defined]
