"""Command of the duel: `run` adds rows to a folder, `report` writes tables and figures from them.

`scripts/duel` runs this module.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.running.stopping import program
from servotrack.baselines.training.duel.figures import draw_budgets, draw_profiles
from servotrack.baselines.training.duel.methods import CLASSICAL, LEARNED, SHIPPED
from servotrack.baselines.training.duel.report import markdown, trained_entries
from servotrack.baselines.training.duel.rows import load_rows
from servotrack.baselines.training.duel.running import DuelPlan, cells_of, run_duel
from servotrack.baselines.training.duel.scoring import entries_of

CELLS = ("UncalibServo-v0:3", "UncalibServo-v0:5", "UncalibServo-v0:6")
BUDGETS = (100_000, 1_000_000)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run or report."""
    import servotrack  # noqa: F401 - registers the ids

    parser = argparse.ArgumentParser(prog="scripts/duel", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run the rows that the folder does not hold yet")
    run.add_argument("folder", type=Path, help="folder of rows")
    run.add_argument("--cells", nargs="+", default=list(CELLS), metavar="ID:LEVEL")
    run.add_argument("--methods", nargs="+", default=[*sorted(SHIPPED), CLASSICAL, *LEARNED])
    run.add_argument("--budgets", nargs="+", type=int, default=list(BUDGETS), metavar="STEPS")
    run.add_argument("--runs", type=int, default=10, help="number of runs (default 10)")
    report = commands.add_parser("report", help="write tables and figures from the rows")
    report.add_argument("folder", type=Path, help="folder of rows")
    report.add_argument("--write", type=Path, help="page with the marks duel:begin and :end")
    report.add_argument("--figures", type=Path, help="folder for duel-budgets.png and duel-profiles.png")
    given = parser.parse_args(arguments)
    with program("finished rows are kept; run the same command again to go on"):
        if given.command == "report":
            _report(given.folder, given.write, given.figures)
            return
        plan = DuelPlan(cells_of(given.cells), tuple(given.methods), tuple(given.budgets), tuple(range(given.runs)))
        run_duel(plan, given.folder, lambda path, new: print(path, "" if new else "(kept)", flush=True))


def _report(folder: Path, page: Path | None, figures: Path | None) -> None:
    """Print the tables of a folder, and write them into a page and figures where these are given."""
    entries = entries_of(load_rows(folder))
    text = markdown(entries, f"scripts/duel report {folder}", code_version())
    show(text, page, "duel")
    if figures is not None:
        draw_budgets(entries, figures / "duel-budgets.png")
        draw_profiles(
            [entry for entry in trained_entries(entries) if entry.cell.world.anchors], figures / "duel-profiles.png"
        )


if __name__ == "__main__":
    main()
