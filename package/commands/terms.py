"""Options that several commands share, and how commands read arguments and print."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servotrack._import_path import append_working_directory

if TYPE_CHECKING:
    from servotrack.baselines.reporting.terminal import Screen

DEFAULT_RESULTS = Path("results")

Results = Annotated[
    Path, typer.Option("--results", "-o", help="Folder of results. Finished episodes in it are not run again.")
]
Episodes = Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes per agent and environment.")]
Split = Annotated[
    str,
    typer.Option(help="Seed range: `test` for reported numbers, `tune` while you are still choosing parameters."),
]
Level = Annotated[int | None, typer.Option("--level", "-l", help="Level of the environment.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", "-s", metavar="KEY=VALUE", help="Argument of the environment. Repeatable.")
]
Jobs = Annotated[int, typer.Option("--jobs", "-j", help="Number of processes. -1 uses all processors.")]

Backend = Annotated[
    str,
    typer.Option(
        "--backend",
        metavar="processes|dask|ray",
        help="What computes: processes of this machine, or a cluster (extra `cluster`) with all its workers.",
    ),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Address of the Dask scheduler or Ray head.")
]

TableFormat = Annotated[
    str, typer.Option("--format", metavar="table|json|csv", help="Format of the printed tables: table, json or csv.")
]


def console(table_format: str = "table") -> Screen:
    """Return the console of a command.

    Args:
        table_format: `table` for people. With `json` or `csv`, stdout holds the tables alone.

    Raises:
        ValueError: Another format.
    """
    from servotrack.baselines.reporting.terminal import Format, Screen

    if table_format not in list(Format):
        raise ValueError(f"--format must be one of {', '.join(Format)}, got {table_format!r}")
    return Screen(Format(table_format))


def words(text: str) -> list[str]:
    """Return the parts of a comma-separated list."""
    return [word.strip() for word in text.split(",") if word.strip()]


def levels_of(text: str) -> list[int]:
    """Return the levels of text such as 0-5 or 0,3; raises ValueError for anything else."""
    levels: list[int] = []
    for word in words(text):
        first, dash, last = word.partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise ValueError(f"levels must look like 0-5 or 0,3, got {text!r}")
        levels.extend(range(int(first), int(last or first) + 1))
    return levels


def find_user_modules(*names: str | None) -> None:
    """Let `module:callable` be found in the working directory; without such a name nothing there is imported.

    Args:
        *names: Agents and environment ids as the user typed them.
    """
    if any(name is not None and ":" in name for name in names):
        append_working_directory()


def env_kwargs(level: int | None, settings: list[str] | None) -> dict[str, Any]:
    """Return environment arguments from the level and from KEY=VALUE; raises ValueError for anything else."""
    kwargs: dict[str, Any] = {} if level is None else {"level": level}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals or not key.isidentifier():
            raise ValueError(f"--set takes KEY=VALUE, got {setting!r}; for example --set pixel_noise=2")
        if key in kwargs:
            raise ValueError(f"{key} is given twice, got {setting!r} after {kwargs[key]!r}")
        try:
            kwargs[key] = ast.literal_eval({"true": "True", "false": "False", "none": "None"}.get(value, value))
        except (ValueError, SyntaxError):
            kwargs[key] = value
    return kwargs


def tracker_values(settings: list[str] | None) -> dict[str, float]:
    """Return parameters of a tracker from PATH=NUMBER; raises ValueError for anything else."""
    values: dict[str, float] = {}
    for setting in settings or []:
        path, equals, text = setting.partition("=")
        number = {"true": 1.0, "false": 0.0}.get(text.lower())
        try:
            number = float(text) if number is None else number
        except ValueError:
            equals = ""
        if not equals or not all(part.isidentifier() or part.isdigit() for part in path.split(".")):
            raise ValueError(f"--set takes NAME=NUMBER, got {setting!r}; for example --set birth=0.05")
        if path in values:
            raise ValueError(f"{path} is given twice, got {setting!r} after {values[path]:g}")
        assert number is not None
        values[path] = int(number) if number.is_integer() and "." not in text else number
    return values
