"""Writes the whole leaderboard into a folder: Markdown, figure, page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from servotrack.baselines.leaderboard.figure import draw_levels, level_tasks
from servotrack.baselines.leaderboard.page import html_page
from servotrack.baselines.leaderboard.summary import TaskSummary
from servotrack.baselines.leaderboard.table import markdown_report
from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import atomic_path

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


def write_report(tasks: Sequence[TaskSummary], folder: Path, command: str, video: Path | None = None) -> list[Path]:
    """Write `leaderboard.md`, `leaderboard.html`, and `levels.png/svg/pdf` where there are servo levels.

    Args:
        tasks: From `summarize`.
        folder: Output folder.
        command: Command that the tables name as their origin.
        video: A film inside `folder` for the page to show.

    Returns:
        The paths written.

    Raises:
        ResultsError: The folder cannot be written.
    """
    written = []
    leveled = level_tasks(tasks)
    if leveled:
        figure = draw_levels(leveled)
        for suffix in FIGURE_SUFFIXES:
            path = folder / f"levels{suffix}"
            save_figure(figure, path)
            written.append(path)
    page = html_page(tasks, command, "levels.svg" if leveled else None, video.name if video else None)
    for name, text in (("leaderboard.md", markdown_report(tasks, command)), ("leaderboard.html", page)):
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
        written.append(folder / name)
    return written
