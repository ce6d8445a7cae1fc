"""Tables of strings: for the terminal (Rich), documents (Markdown) and programs (JSON, CSV)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from typing import NamedTuple

from rich.cells import cell_len
from rich.table import Table

from servotrack.baselines.reporting.plain_text import markdown_cell, markdown_text

_LONGEST_NAME = 30
"""Longest name that a terminal's table keeps in one line, columns."""


class Grid(NamedTuple):
    """A table of strings.

    Attributes:
        headings: One per column.
        rows: Cells.
        words: Number of columns from the left that hold words; the others hold numbers.
        markdown: Columns of words that are Markdown on purpose; in the others, markup is escaped.
    """

    headings: list[str]
    rows: list[list[str]]
    words: int
    markdown: tuple[int, ...] = ()


def as_rich(grid: Grid, title: str) -> Table:
    """A grid for the terminal."""
    table = Table(title=title, title_justify="left", header_style="bold", row_styles=["", "dim"], pad_edge=False)
    for i, heading in enumerate(grid.headings):
        cells = [heading, *(row[i] for row in grid.rows)]
        # Names of one line stay one; else a narrow terminal wraps between words. No word is cut.
        in_one_line = i == 0 and grid.words == 2 and max(map(cell_len, cells)) <= _LONGEST_NAME
        parts = cells if in_one_line else " ".join(cells).split()
        table.add_column(
            heading,
            justify="left" if i < grid.words else "right",
            no_wrap=in_one_line,
            min_width=max(map(cell_len, parts), default=0),
        )
    for row in grid.rows:
        table.add_row(*row)
    return table


def as_markdown(grid: Grid) -> str:
    """A grid as a Markdown table, in which names appear as they are, whatever markup they hold."""
    alignment = [":--" if i < grid.words else "--:" for i in range(len(grid.headings))]

    def shown(cell: str, column: int) -> str:
        is_name = column < grid.words and column not in grid.markdown
        return markdown_text(cell) if is_name else markdown_cell(cell)

    rows = [[shown(cell, i) for i, cell in enumerate(row)] for row in grid.rows]
    lines = [[markdown_cell(heading) for heading in grid.headings], alignment, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def as_sections(grids: Mapping[str, Grid], heading: str) -> str:
    """Tables under their titles as Markdown.

    Args:
        grids: Grids by their titles.
        heading: Prefix of a title, such as "##".
    """
    return "\n".join(f"{heading} {markdown_text(title)}\n\n{as_markdown(grid)}" for title, grid in grids.items())


def as_lines(grid: Grid) -> str:
    """A grid for narrow terminals: one block of lines per row, one line per filled cell."""
    blocks = []
    for row in grid.rows:
        pairs = zip(grid.headings, row, strict=True)
        filled = [f"{heading}: {cell}" for heading, cell in pairs if cell]
        blocks.append("\n  ".join(filled))
    return "\n".join(blocks)


def as_json(tables: Mapping[str, Grid], ascii_only: bool = False) -> str:
    """Return tables as one JSON object: per title a list of rows, each a dictionary by headings.

    Args:
        tables: Grids by their titles.
        ascii_only: If true, other characters are written as escapes.
    """
    rows = {title: [dict(zip(grid.headings, row, strict=True)) for row in grid.rows] for title, grid in tables.items()}
    return json.dumps(rows, indent=1, ensure_ascii=ascii_only)


def as_csv(tables: Mapping[str, Grid]) -> str:
    """Return tables as CSV: the title in the column `table`, then the union of all headings in their order."""
    headings = list(dict.fromkeys(heading for grid in tables.values() for heading in grid.headings))
    text = io.StringIO()
    writer = csv.DictWriter(text, ["table", *headings], restval="", lineterminator="\n")
    writer.writeheader()
    for title, grid in tables.items():
        writer.writerows({"table": title, **dict(zip(grid.headings, row, strict=True))} for row in grid.rows)
    return text.getvalue()
