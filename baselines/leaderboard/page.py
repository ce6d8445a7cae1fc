"""The leaderboard as one static HTML page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from urllib.parse import quote

from servotrack.baselines.leaderboard.summary import TaskSummary
from servotrack.baselines.leaderboard.table import SAME_NOTE, caveat, headline_grids, note_of, overview_grids, task_grid
from servotrack.baselines.reporting.grid import Grid

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2733; background: #fbfbf9; }
body { margin: 0 auto; max-width: 1180px; padding: 40px 24px; }
h1 { font-size: 28px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 40px 0 8px; }
p { max-width: 760px; color: #48566a; } code { background: #eef0ea; padding: 1px 5px; border-radius: 3px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; white-space: nowrap; }
th { text-align: right; font-weight: 600; color: #48566a; border-bottom: 1px solid #9aa5b1; padding: 6px 12px 6px 0; }
td { text-align: right; padding: 4px 12px 4px 0; border-bottom: 1px solid #e6e8e3; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
td:first-child { font-weight: 600; white-space: normal; min-width: 150px; max-width: 230px; }
tr:hover td { background: #f1f3ec; }
img, video { max-width: 100%; display: block; margin: 16px 0; }
""".strip()


def _code(text: str) -> str:
    """Markdown's code in HTML: what stands between backticks."""
    return re.sub("`(.*?)`", r"<code>\1</code>", escape(text))


def html_page(tasks: Sequence[TaskSummary], command: str, figure: str | None, video: str | None) -> str:
    """The page's text.

    Args:
        tasks: From `summarize`.
        command: Command that the page names as its origin.
        figure: Path of the figure beside the page.
        video: Path of a film beside the page.
    """
    parts = [
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>servotrack leaderboard</title>\n<style>\n{STYLE}\n</style>",
        "<h1>servotrack leaderboard</h1>",
        f"<p>Written by <code>{escape(command)}</code>. {_code(note_of(tasks))}</p>",
    ]
    if figure:
        parts.append(f'<img src="{quote(figure)}" alt="Score and success against level, one line per agent">')
    for title, overview in overview_grids(tasks):
        parts += ["<h2>Overview</h2>", f"<p>{escape(title)}. {_code(SAME_NOTE)}</p>", _table(overview)]
    for title, grid in headline_grids(tasks):
        parts += [f"<h2>{escape(title)}</h2>", _table(grid)]
    if video:
        parts.append(f'<video src="{quote(video)}" controls loop muted></video>')
    for task in tasks:
        parts.append(f"<h2>{escape(task.environment)}</h2>")
        if caveat(task):
            parts.append(f"<p>{escape(caveat(task))}</p>")
        parts.append(_table(task_grid(task)))
    return "\n".join(parts) + "\n</html>\n"


def _table(grid: Grid) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in grid.headings)
    body = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in grid.rows)
    return f'<div class="scroll"><table>\n<tr>{head}</tr>\n{body}\n</table></div>'
