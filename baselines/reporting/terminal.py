"""The terminal: tables, progress bars, and the command line of this process."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from enum import Enum

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from servotrack.baselines.reporting.grid import Grid, as_csv, as_json, as_rich

PIPED_WIDTH = 190
"""Width of output that is not a terminal, columns."""


def command_line() -> str:
    """Return the `servotrack` command that this process runs, quoted for a shell."""
    return shlex.join(["servotrack", *sys.argv[1:]])


def progress_bars() -> Progress:
    """Bars with counts and times, on stderr, so that stdout holds results alone."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


class Format(str, Enum):
    """Formats of printed tables."""

    table = "table"
    json = "json"
    csv = "csv"


class Screen(Console):
    """Console of a command. With JSON or CSV, stdout holds the tables alone and everything else goes to stderr.

    Args:
        table_format: Format of the tables.
    """

    def __init__(self, table_format: Format = Format.table) -> None:
        self.table_format = table_format
        super().__init__(highlight=False, stderr=table_format is not Format.table)
        if not self.is_terminal:
            # Tables keep their lines in files and pipes.
            self.width = PIPED_WIDTH


def print_tables(console: Console, tables: Mapping[str, Grid]) -> None:
    """Print tables in the format of the screen; another console prints them for people.

    Args:
        console: Console of the command.
        tables: Grids by their titles. JSON is one object with a list of rows per title; CSV has the title in the first
            column.
    """
    table_format = console.table_format if isinstance(console, Screen) else Format.table
    if table_format is Format.json:
        sys.stdout.write(as_json(tables) + "\n")
    elif table_format is Format.csv:
        sys.stdout.write(as_csv(tables))
    else:
        for title, grid in tables.items():
            console.print(as_rich(grid, title))
