"""Index page over the leaderboards of several worlds."""

from __future__ import annotations

from html import escape
from pathlib import Path
from urllib.parse import quote

from servotrack.baselines.leaderboard.page import STYLE
from servotrack.baselines.reporting.files import atomic_path


def write_index(folder: Path) -> Path:
    """Write `index.html`, which links to the page of every world in `folder`.

    Args:
        folder: Folder whose subfolders hold a `leaderboard.html` each.

    Returns:
        Path of the page.

    Raises:
        ResultsError: The folder cannot be written.
    """
    names = [page.parent.name for page in sorted(folder.glob("*/leaderboard.html"))]
    # A folder may be called `javascript:...`: in an address, colons and the like are quoted.
    items = "\n".join(f'<li><a href="{quote(name)}/leaderboard.html">{escape(name)}</a></li>' for name in names)
    text = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>servotrack leaderboards</title>\n<style>\n{STYLE}\n</style>\n</head>\n<body>\n"
        f"<h1>servotrack leaderboards</h1>\n<ul>\n{items}\n</ul>\n</body>\n</html>\n"
    )
    path = folder / "index.html"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path
