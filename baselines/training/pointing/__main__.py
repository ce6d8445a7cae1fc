"""Command of the experiment with a pointed sensor; `scripts/pointed-sensor` runs this module."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.statistics import bootstrap_mean, paired_difference
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.baselines.training.pointing.experiment import FUTURE, KINDS, MYOPIC, SCENES, Outcome, outcome


def scene_grid(outcomes: dict[str, Outcome]) -> Grid:
    """Return the table of a scene: outcomes by kind of policy."""
    rows, myopic = [], outcomes[MYOPIC]
    for kind, found in outcomes.items():
        cost, ospa, ospa2 = (bootstrap_mean(part) for part in (found.cost, found.ospa, found.ospa2))
        apart = paired_difference(found.cost, myopic.cost)
        rows.append(
            [
                kind,
                f"{cost.value:.3f} [{cost.low:.3f}, {cost.high:.3f}]",
                "" if kind == MYOPIC else f"{apart.value:+.3f} [{apart.low:+.3f}, {apart.high:+.3f}]",
                f"{ospa.value:.1f} [{ospa.low:.1f}, {ospa.high:.1f}]",
                f"{ospa2.value:.1f} [{ospa2.low:.1f}, {ospa2.high:.1f}]",
                f"{100.0 * found.seen.mean():.0f}",
                f"`{found.policy}`",
            ]
        )
    headings = ["policy", "GOSPA / c", "− myopic rule", "OSPA m", "OSPA(2) m", "seen %", "chosen"]
    return Grid(headings, rows, 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, print the tables, and put them into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/pointed-sensor", description=__doc__)
    parser.add_argument("--episodes", type=int, default=100, help="test seeds of each scene (default 100)")
    parser.add_argument("--scenes", type=int, nargs="+", default=range(len(SCENES)), help="numbers of scenes, from 0")
    parser.add_argument("--results", type=Path, default=Path("results/pointing"), help="folder of the outcomes")
    parser.add_argument("--write", type=Path, help="page with the marks pointing:begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 2:
        parser.error(f"--episodes must be at least 2, got {given.episodes}")
    if not all(0 <= number < len(SCENES) for number in given.scenes):
        parser.error(f"--scenes must be numbers from 0 to {len(SCENES) - 1}, got {given.scenes}")
    with program("finished outcomes are kept; run the same command again"):
        parts = []
        for scene in (SCENES[number] for number in given.scenes):
            outcomes = {kind: outcome(kind, scene, given.episodes, given.results) for kind in KINDS}
            axes = ", ".join(f"{name}={value}" for name, value in scene.axes.items()) or "none"
            margin = 1.0 - outcomes[FUTURE].cost.mean() / outcomes[MYOPIC].cost.mean()
            parts.append(
                f"### {scene.name.capitalize()}\n\nField of view: {scene.shape}, {scene.rate:g} m per scan. Level 1, "
                f"changed: {axes}. The oracle's cost is {100.0 * margin:.0f} % below that of the myopic rule.\n\n"
                f"{as_markdown(scene_grid(outcomes))}"
            )
        text = "\n\n".join(parts) + (
            f"\n\n{given.episodes} test seeds; brackets: 95 % intervals; differences paired by seed. Written by "
            f"`scripts/pointed-sensor --episodes {given.episodes}`, servotrack {code_version()}."
        )
        show(text, given.write, "pointing")


if __name__ == "__main__":
    main()
