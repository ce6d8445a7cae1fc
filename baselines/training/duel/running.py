"""Run the duel: every method in every cell with every budget, one row per run; finished rows are skipped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.training.duel.cells import Cell
from servotrack.baselines.training.duel.learned import train_within
from servotrack.baselines.training.duel.methods import CLASSICAL, LEARNED, SHIPPED, shipped_card, supports
from servotrack.baselines.training.duel.rows import DuelRow, path_of, save
from servotrack.baselines.tuning.racing import search_cell
from servotrack.baselines.tuning.structures import structures_for


@dataclass(frozen=True)
class DuelPlan:
    """Rows to be run: all combinations.

    Attributes:
        cells: The cells.
        methods: Names of methods: `CLASSICAL`, a key of `LEARNED`, or one of `SHIPPED`.
        budgets: Environment steps of each run, search included.
        runs: Numbers of the runs. Reference agents have one, number 0.
    """

    cells: tuple[Cell, ...]
    methods: tuple[str, ...]
    budgets: tuple[int, ...]
    runs: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check names and numbers."""
        known = (CLASSICAL, *LEARNED, *sorted(SHIPPED))
        if strange := [name for name in self.methods if name not in known]:
            raise ValueError(f"methods must be of {', '.join(known)}, got {strange[0]!r}")
        for name, values, least in (("budgets", self.budgets, 1), ("runs", self.runs, 0)):
            if not values or min(values) < least:
                raise ValueError(f"{name} must be whole numbers >= {least}, at least one, got {values}")

    def rows(self) -> list[tuple[Cell, str, int, int]]:
        """Return cell, method, budget and run of each row: references first, then run by run, small budgets first.

        Methods that do not support a cell are left out there.
        """
        shipped = [
            (cell, name, 0, 0)
            for cell in self.cells
            for name in self.methods
            if name in SHIPPED and supports(name, cell)
        ]
        trained = [name for name in self.methods if name not in SHIPPED]
        return shipped + [
            (cell, name, budget, run)
            for run in self.runs
            for budget in sorted(self.budgets)
            for cell in self.cells
            for name in trained
            if supports(name, cell)
        ]


def run_duel(plan: DuelPlan, folder: Path, on_row: Callable[[Path, bool], None] = lambda path, new: None) -> None:
    """Run all rows of a plan that the folder does not hold yet.

    Args:
        plan: The rows.
        folder: Folder of the rows. A row is written when it is complete; networks are not kept.
        on_row: Called with the path of each row, and True if it was run now.

    Raises:
        ValueError: A method that does not support a cell.
        ResultsError: The folder cannot be written.
    """
    for cell, method, budget, run in plan.rows():
        path = path_of(folder, cell, method, budget, run)
        if not path.exists():
            save(folder, run_row(cell, method, budget, run, folder / ".unfinished" / path.stem))
            on_row(path, True)
        else:
            on_row(path, False)
    shutil.rmtree(folder / ".unfinished", ignore_errors=True)


def run_row(cell: Cell, method: str, budget: int, run: int, folder: Path) -> DuelRow:
    """Run one row.

    Args:
        cell: The cell.
        method: Name of the method.
        budget: Environment steps, search included.
        run: Number of the run; all its seeds derive from it.
        folder: Folder for a training's files; removed at the end.
    """
    origin, begin = provenance(), time.process_time()
    information, search, chosen, steps = "observations", [], {}, {"search": 0, "training": 0}
    if method in SHIPPED:
        agent = shipped_card(method)
        information = agent.information
    elif method == CLASSICAL:
        found = search_cell(cell.env_id, cell.level, budget, run)
        agent, search, chosen = structures_for(cell.env_id).card(found.chosen), found.as_record(), found.chosen
        steps = {"search": found.steps, "training": 0}
    else:
        trained = train_within(LEARNED[method], cell, budget, run, folder)
        agent, search, chosen, steps = trained.agent, trained.trials, trained.settings, trained.steps
        information = LEARNED[method].information
    seconds = round(time.process_time() - begin, 1)
    row = DuelRow(
        cell.env_id, cell.level, method, information, budget, run, steps, seconds, search, chosen,
        cell.test(agent), cell.test_held_out(agent), origin,
    )  # fmt: skip
    shutil.rmtree(folder, ignore_errors=True)
    return row


def cells_of(texts: Sequence[str]) -> tuple[Cell, ...]:
    """Read cells written as ID:LEVEL.

    Raises:
        ValueError: A text of another form.
    """
    cells = []
    for text in texts:
        env_id, colon, level = text.rpartition(":")
        if not colon or not level.isdigit():
            raise ValueError(f"a cell must be ID:LEVEL, such as UncalibServo-v0:6, got {text!r}")
        cells.append(Cell(env_id, int(level)))
    return tuple(cells)
