"""The terminal: tables, progress bars, and the command line of this process."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping
from enum import Enum
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from servotrack.baselines.reporting.grid import Grid, as_csv, as_json, as_lines, as_rich
from servotrack.baselines.reporting.plain_text import ENCODING_ERRORS, encodable, printable

PIPED_WIDTH = 190
"""Width of output that is not a terminal, columns."""
_UNBOUNDED = 10_000
CLOSED_PIPE = 141
"""Exit code of a command whose reader left early, as `head` does: 128 plus the number of SIGPIPE."""


def command_line() -> str:
    """Return the `servotrack` command that this process runs, quoted for a shell."""
    return shlex.join(["servotrack", *sys.argv[1:]])


class _Reader:
    """The program that reads standard output."""

    left = False


def reader_left() -> bool:
    """Return True if the reader of standard output closed it before the end. Later output is dropped."""
    return _Reader.left


def _let_reader_go() -> None:
    """Drop all further output: the command still writes its files."""
    _Reader.left = True
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def accept_all_symbols() -> None:
    """Make standard output and error write the closest ASCII text for symbols that their encoding lacks."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None and not _is_unicode(stream):
            reconfigure(errors=ENCODING_ERRORS)


def _is_unicode(stream: Any) -> bool:
    return str(getattr(stream, "encoding", None) or "utf-8").lower().startswith("utf")


class PlainConsole(Console):
    """Console that prints text as it is: brackets and colons are no markup, control characters are visible.

    Symbols that the terminal's encoding lacks are replaced before the layout, so that columns stay in line.
    """

    def __init__(self, **options: Any) -> None:
        accept_all_symbols()
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **options})

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text to print; see `rich.console.Console.render_str`."""
        return super().render_str(encodable(printable(text), self.encoding), **options)

    def on_broken_pipe(self) -> None:
        """Go on without output when the reader has left."""
        _let_reader_go()


def progress_bars(*columns: ProgressColumn, quiet: bool = False) -> Progress:
    """Bars on stderr, so that stdout holds results alone.

    Args:
        columns: Columns; none for descriptions, bars, counts and times.
        quiet: True shows nothing.
    """
    usual = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*(columns or usual), console=PlainConsole(stderr=True, quiet=quiet))


class Format(str, Enum):
    """Formats of printed tables."""

    table = "table"
    json = "json"
    csv = "csv"


class Screen(PlainConsole):
    """Console of a command. With JSON or CSV, stdout holds the tables alone and everything else goes to stderr.

    Args:
        table_format: Format of the tables.
    """

    def __init__(self, table_format: Format = Format.table) -> None:
        self.table_format = table_format
        super().__init__(stderr=table_format is not Format.table)
        if not self.is_terminal:
            # Tables keep their lines in files and pipes.
            self.width = PIPED_WIDTH


def print_tables(console: Console, tables: Mapping[str, Grid]) -> None:
    """Print tables in the format of the screen; another console prints them for people.

    A table that a terminal is too narrow for is printed as one block of lines per row.

    Args:
        console: Console of the command.
        tables: Grids by their titles. JSON is one object with a list of rows per title; CSV has the title in the first
            column.
    """
    table_format = console.table_format if isinstance(console, Screen) else Format.table
    if table_format is Format.json:
        _write(as_json(tables, ascii_only=not _is_unicode(sys.stdout)) + "\n")
    elif table_format is Format.csv:
        _write(as_csv(tables))
    else:
        for title, grid in tables.items():
            table = as_rich(grid, title)
            unbounded = console.options.update_width(_UNBOUNDED)
            if console.measure(table, options=unbounded).minimum > console.width:
                console.print(title, style="bold")
                console.print(as_lines(grid))
            else:
                console.print(table)


def _write(text: str) -> None:
    """Write to standard output; nothing where it is closed."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        _let_reader_go()
