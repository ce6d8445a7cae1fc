"""Commands in the documents parse: the command, its arguments and its options exist. Marked ones run."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
import typer

from servotrack.__main__ import app

ROOT = Path(__file__).parents[2]
PAGES = [
    page
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
    if "environments" not in page.parts
]
SHELL = re.compile(r"(<!-- run -->\n)?^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"`((?:\.venv/bin/)?servotrack [a-z][^`]*)`")


def _lines(script: str) -> list[str]:
    lines = script.replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def commands(page: Path) -> list[str]:
    """Return every line of the shell blocks of a page, and every command in its text."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in SHELL.finditer(text) for line in _lines(block[2])]
    return lines + [" ".join(found.split()) for found in INLINE.findall(text)]


def fault(command: str) -> str | None:
    """Return why a command cannot run, None if it can."""
    words = shlex.split(command, comments=True)
    if words[0] == "export":
        return None if all("=" in word for word in words[1:]) else f"{words} exports no value"
    name, arguments = words[0].removeprefix(".venv/bin/"), words[1:]
    if name == "servotrack":
        return _fault_of_arguments(arguments)
    if name.startswith("scripts/"):
        return None if (ROOT / name).is_file() else f"{name} does not exist"
    if name == "python" and arguments[:1] == ["-m"]:
        module = arguments[1]
        return None if importlib.util.find_spec(module) else f"no module {module}"
    if name in ("python", "python3"):
        return None if not arguments or (ROOT / arguments[0]).is_file() else f"{arguments[0]} does not exist"
    if name in ("pip", "cd", "git", "dask", "ray"):
        return None
    return f"unknown program {name}"


def _fault_of_arguments(arguments: list[str]) -> str | None:
    group = typer.main.get_command(app)
    assert isinstance(group, click.Group) or hasattr(group, "commands")
    if not arguments or arguments[0].startswith("-"):
        return None
    if arguments[0] not in group.commands:
        return f"no command {arguments[0]}"
    # Text such as "`servotrack reproduce`" names a command without calling it.
    command = group.commands[arguments[0]]
    try:
        command.make_context(arguments[0], arguments[1:], resilient_parsing=len(arguments) == 1)
    except Exception as error:
        return getattr(error, "message", str(error))
    return None


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.name)
def test_commands_parse(page: Path) -> None:
    faults = [f"{command}: {found}" for command in commands(page) if (found := fault(command))]
    assert not faults, "\n".join(faults)


def test_wrong_commands_are_found() -> None:
    assert fault(".venv/bin/servotrack bench --level 0-5") is not None
    assert fault("servotrack banch") is not None
    assert fault("scripts/nothing") is not None
    assert fault("servotrack bench --levels 0-5  # all") is None


RUN = [(page, block[2]) for page in PAGES for block in SHELL.finditer(page.read_text(encoding="utf-8")) if block[1]]


@pytest.mark.parametrize(("page", "script"), RUN, ids=[page.name for page, _ in RUN])
def test_marked_commands_run(page: Path, script: str, tmp_path: Path) -> None:
    for line in _lines(script):
        words = shlex.split(line, comments=True)
        assert words[0] == ".venv/bin/servotrack"
        run = subprocess.run(
            [sys.executable, "-m", "servotrack", *words[1:]], capture_output=True, text=True, check=False, cwd=tmp_path
        )
        assert run.returncode == 0, f"{line}: {run.stderr}"
    assert any(tmp_path.rglob("*.txt"))


def test_there_are_commands_that_run() -> None:
    assert RUN
