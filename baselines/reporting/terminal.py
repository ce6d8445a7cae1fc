"""The command line of this process, as tables and documents quote it."""

from __future__ import annotations

import shlex
import sys

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


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
