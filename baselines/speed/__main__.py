"""`python -m servotrack.baselines.speed`: what `scripts/benchmark` runs."""

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
from servotrack.baselines.speed import accuracy, bearings, clutter, learning, speed, video


def speed_report(
    pusht_python: str | None, stone_soup_python: str | None, rounds: int, seconds: float, console: Console
) -> str:
    """The tables of rates: worlds and Jacobian filters, set filters, video, bearings, and learning."""

    def table(rows: list[speed.Subject]) -> str:
        with Progress(console=console, transient=True) as progress:
            bar = progress.add_task("rates", total=len(rows) * rounds)
            rates = speed.measure(rows, rounds, seconds, lambda name: progress.update(bar, advance=1, description=name))
        return speed.table(rows, rates)

    with tempfile.TemporaryDirectory() as folder:
        scans = clutter.write_scans(Path(folder) / "scans.npz")
        parts = [
            f"## Speed\n\nMedian of {rounds} rounds of {seconds:g} s.\n\n{table(speed.subjects(pusht_python))}\n",
            "## Set filters\n\nScans of paper 004's scenario filtered per second, a batch's runs added up.\n\n"
            f"{table(clutter.subjects(scans, stone_soup_python))}\n",
            "## Video\n\nFrames of 384 x 288 per second, one thread; 300 x 245 for the color trackers.\n\n"
            f"{table(video.subjects())}\n",
            "## Bearings\n\nTargets followed per second through a minute of record, one thread; "
            f"where that does not fall, cost is linear in the targets.\n\n{table(bearings.subjects())}\n",
            "## Learning\n\nSteps of PPO with the same policy, and answers of shipped agents; one thread.\n\n"
            f"{table(learning.subjects())}\n",
        ]
        if stone_soup_python is not None:
            found = clutter.errors(scans, stone_soup_python, sys.executable)
            listed = ", ".join(f"{name} {error:.3f} m" for name, error in found.items())
            parts.append(f"Mean OSPA (c = 100 m, p = 1) on the same scans: {listed}.\n")
    return "\n".join(parts)


def accuracy_report(episodes: int, jobs: int, console: Console) -> str:
    """The tables of wanted figures and of gaps to the informed bound."""
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("agents", total=len(accuracy.cells()))
        found = accuracy.run(episodes, jobs, lambda: progress.advance(bar))
    return (
        f"## Accuracy\n\n{episodes} test seeds each, 95 % intervals.\n\n{accuracy.wanted_table(found)}\n\n"
        f"## Level 6\n\n{accuracy.gap_table(found)}\n"
    )


def heading() -> str:
    """What the figures were measured with."""
    record = provenance()
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    load = f"; load average at the start {os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else ""
    return f"# Benchmark\n\n{record['created']}, {platform.system()} on {os.cpu_count()} cores{load}. {versions}.\n"


def main() -> None:
    """Measure, print, and write where asked to."""
    parser = argparse.ArgumentParser(prog="scripts/benchmark", description=__doc__)
    parser.add_argument("--accuracy", action="store_true", help="the agents' figures instead of rates")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each rate (default 7)")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of each, s (default 1)")
    parser.add_argument("--episodes", type=int, default=1000, help="test seeds per agent (default 1000)")
    parser.add_argument("--jobs", type=int, default=2, help="processes that evaluate agents (default 2)")
    parser.add_argument("--pusht-python", help="interpreter that has gym-pusht and pymunk<7")
    parser.add_argument("--stone-soup-python", help="interpreter that has stonesoup")
    parser.add_argument("--write", type=Path, help="also write the report to this file")
    arguments = parser.parse_args()
    for name in ("rounds", "seconds", "episodes", "jobs"):
        if getattr(arguments, name) <= 0:
            parser.error(f"--{name} must be positive, got {getattr(arguments, name)}")

    top, console = heading(), Console(stderr=True)
    if arguments.accuracy:
        body = accuracy_report(arguments.episodes, arguments.jobs, console)
    else:
        body = speed_report(
            arguments.pusht_python, arguments.stone_soup_python, arguments.rounds, arguments.seconds, console
        )
    report = f"{top}\n{body}"
    print(report)
    if arguments.write:
        arguments.write.write_text(report, encoding="utf-8")


if __name__ == "__main__":
    main()
