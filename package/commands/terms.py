"""Options that several commands share, and how commands read arguments and print."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from servotrack.baselines.reporting.grid import Grid

DEFAULT_RESULTS = Path("results")
PIPED_WIDTH = 190

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


class Format(str, Enum):
    """Formats of printed tables."""

    table = "table"
    json = "json"
    csv = "csv"


TableFormat = Annotated[Format, typer.Option("--format", help="Format of the printed tables.")]


def console() -> Console:
    """Return the console for command output. When piped it is 190 columns wide, so that table rows do not wrap."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPED_WIDTH)


def print_tables(tables: Mapping[str, Grid], table_format: Format = Format.table) -> None:
    """Print tables to stdout.

    Args:
        tables: Grids by their titles.
        table_format: `table` for people; `json` prints one object with a list of rows per title; `csv` prints all rows
            with the title in the first column.
    """
    from servotrack.baselines.reporting.grid import as_csv, as_json, as_rich

    if table_format is Format.json:
        typer.echo(as_json(tables))
    elif table_format is Format.csv:
        typer.echo(as_csv(tables), nl=False)
    else:
        for title, grid in tables.items():
            console().print(as_rich(grid, title))


def print_notes(*lines: str, table_format: Format = Format.table, style: str | None = None) -> None:
    """Print notes and paths below tables; to stderr where stdout holds JSON or CSV."""
    from rich.console import Console

    screen = console() if table_format is Format.table else Console(stderr=True, highlight=False)
    for line in lines:
        screen.print(line, soft_wrap=True, style=style, markup=False)


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
