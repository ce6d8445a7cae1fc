"""Rows of the duel on disk: one JSON file per cell, method, budget and run, with the numbers of every episode."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from servotrack.baselines.reporting.files import ResultsError, atomic_path, read_document
from servotrack.baselines.training.duel.cells import Cell, Columns

FORMAT, FORMAT_VERSION = "servotrack-duel", 1


@dataclass(frozen=True)
class DuelRow:
    """One run of a method in a cell. Scores are computed from it, never stored.

    Attributes:
        env_id: Gymnasium id.
        level: Level.
        method: Name of the method, or of a reference agent.
        information: Data that the method sees in training.
        budget: Environment steps that it may take; 0 for a reference agent.
        run: Number of the run.
        steps: Environment steps taken: `search` and `training`.
        seconds: CPU time of search and training, s.
        search: Record of the search: races of a classical one, trials of a learned one.
        chosen: Structure or settings of the final agent.
        test: Numbers of the test episodes by column.
        held_out: The same in wider ranges.
        provenance: Versions, machine, command, creation time (UTC).
    """

    env_id: str
    level: int
    method: str
    information: str
    budget: int
    run: int
    steps: dict[str, int]
    seconds: float
    search: list[Any]
    chosen: dict[str, Any]
    test: Columns
    held_out: Columns
    provenance: dict[str, Any]

    @property
    def cell(self) -> Cell:
        """The cell."""
        return Cell(self.env_id, self.level)


def path_of(folder: Path, cell: Cell, method: str, budget: int, run: int) -> Path:
    """Return the path of a row."""
    return folder / cell.title / f"{method}-{budget}-{run}.json"


def save(folder: Path, row: DuelRow) -> Path:
    """Write a row, whole or not at all, and return its path."""
    path = path_of(folder, row.cell, row.method, row.budget, row.run)
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(row)}
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def load_rows(folder: Path) -> list[DuelRow]:
    """Read all rows of a folder, in the order of their paths.

    Raises:
        ResultsError: No rows, or a file that is none.
    """
    paths = sorted(folder.glob("*/*.json"))
    if not paths:
        raise ResultsError(f"{folder} holds no rows of a duel; run `scripts/duel run` first")
    return [_row(path) for path in paths]


def _row(path: Path) -> DuelRow:
    remedy = "restore it, or remove it and run `scripts/duel run` again"
    document = read_document(path, FORMAT, FORMAT_VERSION, "no row of a duel", remedy)
    try:
        row = DuelRow(**{name: value for name, value in document.items() if not name.startswith("format")})
        if path.name != path_of(path.parent.parent, row.cell, row.method, row.budget, row.run).name:
            raise ValueError("its name is that of another row")
        return row
    except (TypeError, ValueError, KeyError) as error:
        raise ResultsError(f"{path} is corrupt ({type(error).__name__}: {error}); {remedy}") from error
