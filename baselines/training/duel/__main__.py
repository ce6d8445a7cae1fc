"""Command of the duel: `run` adds rows to a folder, `report` writes tables and figures from them.

`scripts/duel` runs this module.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from servotrack.baselines.running.stopping import program
from servotrack.baselines.training.duel.methods import CLASSICAL, LEARNED, REFERENCES
from servotrack.baselines.training.duel.running import DuelPlan, cells_of, run_duel

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
    run.add_argument("--methods", nargs="+", default=[*REFERENCES, CLASSICAL, *LEARNED])
    run.add_argument("--budgets", nargs="+", type=int, default=list(BUDGETS), metavar="STEPS")
    run.add_argument("--runs", type=int, default=10, help="number of runs (default 10)")
    given = parser.parse_args(arguments)
    with program("finished rows are kept; run the same command again to go on"):
        plan = DuelPlan(cells_of(given.cells), tuple(given.methods), tuple(given.budgets), tuple(range(given.runs)))
        run_duel(plan, given.folder, lambda path, new: print(path, "" if new else "(kept)", flush=True))


if __name__ == "__main__":
    main()
