"""Measure speed, or accuracy targets with `--accuracy`. `scripts/speed` runs this module."""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.running.stopping import program
from servotrack.baselines.speed import accuracy, bearings, environments, learning, rates, set_filters, video


def speed_report(
    pusht_python: str | None, stone_soup_python: str | None, rounds: int, seconds: float, console: Console
) -> str:
    """Return the tables of rates: environments and Jacobian filters, set filters, video, bearings, and learning.

    Args:
        pusht_python: Interpreter that has gym-pusht and pymunk<7; None if there is none.
        stone_soup_python: Interpreter that has Stone Soup; None if there is none.
        rounds: Measurements of each rate.
        seconds: Duration of one measurement, s.
        console: Console for the progress bars.
    """

    def table(rows: list[rates.Subject]) -> str:
        with Progress(console=console, transient=True) as progress:
            bar = progress.add_task("rates", total=len(rows) * rounds)
            found = rates.measure(rows, rounds, seconds, lambda name: progress.update(bar, advance=1, description=name))
        return rates.table(rows, found)

    with tempfile.TemporaryDirectory() as folder:
        scans = set_filters.write_scans(Path(folder) / "scans.npz")
        parts = [
            f"## Environments\n\nMedian of {rounds} rounds of {seconds:g} s.\n\n"
            f"{table(environments.subjects(pusht_python))}\n",
            "## Set filters\n\nScans of pairwise_markov's scenario filtered per second, summed over a batch's runs.\n\n"
            f"{table(set_filters.subjects(scans, stone_soup_python))}\n",
            "## Video\n\nFrames of 384 x 288 per second, one thread; 300 x 245 for the color trackers.\n\n"
            f"{table(video.subjects())}\n",
            "## Bearings\n\nTargets followed per second through a minute of record, one thread. "
            f"Cost is linear in the number of targets if the rate stays constant.\n\n{table(bearings.subjects())}\n",
            "## Learning\n\nSteps of PPO with the same policy, and answers of shipped agents; one thread.\n\n"
            f"{table(learning.subjects())}\n",
        ]
        if stone_soup_python is not None:
            found = set_filters.errors(scans, stone_soup_python, sys.executable)
            listed = ", ".join(f"{name} {error:.3f} m" for name, error in found.items())
            parts.append(f"Mean OSPA (c = 100 m, p = 1) on the same scans: {listed}.\n")
    return "\n".join(parts)


def accuracy_report(episodes: int, jobs: int, console: Console) -> str:
    """Return the tables of accuracy targets and of gaps to the informed agent.

    Args:
        episodes: Test seeds per agent.
        jobs: Processes that evaluate agents.
        console: Console for the progress bar.
    """
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("agents", total=len(accuracy.cells()))
        found = accuracy.run(episodes, jobs, lambda: progress.advance(bar))
    return (
        f"## Targets\n\n{episodes} test seeds each, 95 % intervals.\n\n{accuracy.target_table(found)}\n\n"
        f"## Level 6\n\n{accuracy.gap_table(found)}\n"
    )


def heading(title: str) -> str:
    """Return the title with date, machine and versions."""
    record = provenance()
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    load = f"; load average at the start {os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else ""
    return f"# {title}\n\n{record['created']}, {platform.system()} on {os.cpu_count()} cores{load}. {versions}.\n"


def main() -> None:
    """Measure, print the report, and write it to `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/speed", description=__doc__)
    parser.add_argument("--accuracy", action="store_true", help="measure the agents' accuracy targets instead of rates")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each rate (default 7)")
    parser.add_argument("--seconds", type=float, default=1.0, help="duration of one measurement, s (default 1)")
    parser.add_argument("--episodes", type=int, default=1000, help="test seeds per agent (default 1000)")
    parser.add_argument("--jobs", type=int, default=2, help="processes that evaluate agents (default 2)")
    parser.add_argument("--pusht-python", help="interpreter that has gym-pusht and pymunk<7")
    parser.add_argument("--stone-soup-python", help="interpreter that has stonesoup")
    parser.add_argument("--write", type=Path, help="also write the report to this file")
    arguments = parser.parse_args()
    for name in ("rounds", "seconds", "episodes", "jobs"):
        if getattr(arguments, name) <= 0:
            parser.error(f"--{name} must be positive, got {getattr(arguments, name)}")

    with program("nothing is written; run the same command again"):
        _measure(arguments)


def _measure(arguments: argparse.Namespace) -> None:
    """Measure what the arguments say, print the report and write it."""
    top, console = heading("Accuracy targets" if arguments.accuracy else "Speed"), Console(stderr=True)
    if arguments.accuracy:
        body = accuracy_report(arguments.episodes, arguments.jobs, console)
    else:
        body = speed_report(
            arguments.pusht_python, arguments.stone_soup_python, arguments.rounds, arguments.seconds, console
        )
    report = f"{top}\n{body}"
    print(report)
    if arguments.write:
        with atomic_path(arguments.write) as temporary:
            temporary.write_text(report, encoding="utf-8")


if __name__ == "__main__":
    main()
