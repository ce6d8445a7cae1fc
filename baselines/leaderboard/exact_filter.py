"""Compare the PMB filter with the PMBM filter, whose posterior it projects, on the same tune seeds.

`scripts/exact-filter` runs this module.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.evaluation.statistics import paired_difference
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program

ENV_ID = "ClutterTracking-v0"
APPROXIMATE, EXACT = "pmb", "pmbm"
FIRST = 60_000
"""Offset of the seeds in the tune range; the defaults of the filters were chosen on earlier ones."""

_CLOSE = {
    "level": 1,
    "structure": "HMM",
    "half_width": 100.0,
    "acceleration_noise": 1.0,
    "position_noise": 3.0,
    "birth_speed": 3.0,
    "initial_targets": 8.0,
    "clutter_rate": 10.0,
    "detection_probability": 0.9,
    "cutoff": 20.0,
}

SCENES: Mapping[str, Mapping[str, Any]] = {
    "level 0": {"level": 0},
    "level 2": {"level": 2},
    "level 3": {"level": 3},
    "close": _CLOSE,
    "close, p_D = 0.6": {**_CLOSE, "detection_probability": 0.6},
}
"""Keywords of the environment by the name of the scene."""

METRICS = {"OSPA": "ospa", "OSPA(2)": "ospa2"}


def compare(scene: Mapping[str, Any], seeds: Sequence[int]) -> dict[str, dict[str, list[float]]]:
    """Play the episodes of a scene with both filters.

    Args:
        scene: Keywords of the environment.
        seeds: Seeds, the same for both.

    Returns:
        Values by metric and agent, one per seed, m.
    """
    cells = {agent: evaluate(ENV_ID, agent, seeds, env_kwargs=scene) for agent in (APPROXIMATE, EXACT)}
    rows = {agent: {row["seed"]: row for row in cell.rows} for agent, cell in cells.items()}
    return {
        title: {agent: [rows[agent][seed][key] for seed in seeds] for agent in rows} for title, key in METRICS.items()
    }


def table(found: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> Grid:
    """Return means of both filters and their paired difference.

    Args:
        found: Results of `compare` by scene.
    """
    rows = []
    for scene, metrics in found.items():
        for title, values in metrics.items():
            loss = paired_difference(values[APPROXIMATE], values[EXACT])
            means = [f"{sum(values[agent]) / len(values[agent]):.2f}" for agent in (APPROXIMATE, EXACT)]
            rows.append([scene, title, *means, f"{loss.value:+.2f} [{loss.low:+.2f}, {loss.high:+.2f}]"])
    return Grid(["scene", "m", APPROXIMATE, EXACT, f"{APPROXIMATE} - {EXACT}"], rows, words=2)


def main(arguments: Sequence[str] | None = None) -> None:
    """Play all scenes, print the table and put it into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/exact-filter", description=__doc__)
    parser.add_argument("--episodes", type=int, default=100, help="tune seeds of each scene (default 100)")
    parser.add_argument("--write", type=Path, help="page with the marks exact-filter:begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {given.episodes}")
    with program("nothing is written; run the same command again"):
        seeds = take("tune", given.episodes, FIRST)
        grid = table({name: compare(scene, seeds) for name, scene in SCENES.items()})
        source = f"`scripts/exact-filter --episodes {given.episodes}`, servotrack {code_version()}"
        text = (
            f"{as_markdown(grid)}\n\n{given.episodes} tune seeds each ({seeds[0]} to {seeds[-1]}), paired, with 95 % "
            f"bootstrap intervals. Written by {source}."
        )
        show(text, given.write, "exact-filter")


if __name__ == "__main__":
    main()
