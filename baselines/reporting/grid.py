"""Tables of strings: for the terminal (Rich), documents (Markdown) and programs (JSON, CSV)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from typing import NamedTuple

from rich.table import Table


class Grid(NamedTuple):
    """A table of strings.

    Attributes:
        headings: One per column.
        rows: Cells.
        words: Number of columns from the left that hold words; the others hold numbers.
    """

    headings: list[str]
    rows: list[list[str]]
    words: int


def as_rich(grid: Grid, title: str) -> Table:
    """A grid for the terminal."""
    table = Table(title=title, title_justify="left", header_style="bold", row_styles=["", "dim"], pad_edge=False)
    for i, heading in enumerate(grid.headings):
        table.add_column(heading, justify="left" if i < grid.words else "right", no_wrap=i == 0 and grid.words == 2)
    for row in grid.rows:
        table.add_row(*row)
    return table


def as_markdown(grid: Grid) -> str:
    """A grid as a Markdown table."""
    alignment = [":--" if i < grid.words else "--:" for i in range(len(grid.headings))]
    lines = [grid.headings, alignment, *grid.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def as_sections(grids: Mapping[str, Grid], heading: str) -> str:
    """Tables under their titles as Markdown.

    Args:
        grids: Grids by their titles.
        heading: Prefix of a title, such as "##".
    """
    return "\n".join(f"{heading} {title}\n\n{as_markdown(grid)}" for title, grid in grids.items())


def as_json(tables: Mapping[str, Grid]) -> str:
    """Return tables as one JSON object: per title a list of rows, each a dictionary by headings."""
    rows = {title: [dict(zip(grid.headings, row, strict=True)) for row in grid.rows] for title, grid in tables.items()}
    return json.dumps(rows, indent=1, ensure_ascii=False)


def as_csv(tables: Mapping[str, Grid]) -> str:
    """Return tables as CSV: the title in the column `table`, then the union of all headings in their order."""
    headings = list(dict.fromkeys(heading for grid in tables.values() for heading in grid.headings))
    text = io.StringIO()
    writer = csv.DictWriter(text, ["table", *headings], restval="", lineterminator="\n")
    writer.writeheader()
    for title, grid in tables.items():
        writer.writerows({"table": title, **dict(zip(grid.headings, row, strict=True))} for row in grid.rows)
    return text.getvalue()
