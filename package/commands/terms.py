"""What several commands share: their options, and how they read and print."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

DEFAULT_RESULTS = Path("results")
PIPED_WIDTH = 190

Results = Annotated[Path, typer.Option("--results", "-o", help="Folder of results; an earlier run there is resumed.")]
Episodes = Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes per agent and environment.")]
Split = Annotated[str, typer.Option(help="Seeds: `test` to report, `tune` while anything is still being chosen.")]
Level = Annotated[int | None, typer.Option("--level", "-l", help="Level of the environment.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", "-s", metavar="KEY=VALUE", help="Argument of the environment; repeatable.")
]
Jobs = Annotated[int, typer.Option("--jobs", "-j", help="Processes; -1 for all processors.")]


def console() -> Console:
    """Where commands print; wide where nobody looks, so that tables keep their lines."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPED_WIDTH)


def words(text: str) -> list[str]:
    """Parts of a list with commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def levels_of(text: str) -> list[int]:
    """Whole numbers and ranges with commas, such as 0-5 or 0,3; raises ValueError for anything else."""
    levels: list[int] = []
    for word in words(text):
        first, dash, last = word.partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise ValueError(f"levels must look like 0-5 or 0,3, got {text!r}")
        levels.extend(range(int(first), int(last or first) + 1))
    return levels


def env_kwargs(level: int | None, settings: list[str] | None) -> dict[str, Any]:
    """Arguments of an environment from its level and from KEY=VALUE; raises ValueError for what is neither."""
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
