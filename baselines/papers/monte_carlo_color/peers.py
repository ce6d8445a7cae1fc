"""Compare `MonteCarloColorPlus` with OpenCV's correlation filters on every level and axis of ColorTracking-v0.

`scripts/color-peers` runs this module in an environment with OpenCV's contrib wheel.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from joblib import delayed
from rich.console import Console

from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.statistics import bootstrap_mean, paired_difference
from servotrack.baselines.papers.monte_carlo_color.experiment import scored_seeds
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.baselines.running.workers import in_workers
from servotrack.baselines.tuning.color_films import film, track
from servotrack.envs.track.color.config import LEVEL_NAMES

OURS = "monte-carlo-color-plus"
PEERS = ("csrt", "kcf", "kernel-mean-shift")

HARD_AXES: Mapping[str, Mapping[str, Any]] = {
    "speed": {"speed": 12.0},
    "restlessness": {"speed": 8.0, "restlessness": 8.0},
    "turning": {"turning": 1.0},
    "tilt": {"tilt": 0.4},
    "spin": {"spin": 5.0},
    "growth": {"growth": 2.2},
    "occlusions": {"occlusions": 6},
    "occlusion_frames": {"occlusions": 3, "occlusion_frames": 15.0},
    "distractors": {"distractors": 4},
    "similarity": {"distractors": 1, "similarity": 1.0},
    "zoom": {"zoom": 2.2},
    "pan": {"pan": 90.0},
    "light_change": {"light_change": 3.0},
    "light_tint": {"light_tint": 1.8},
    "camouflage": {"camouflage": 1.0},
    "sensor_noise": {"sensor_noise": 20.0},
    "head_height": {"head_height": 20.0},
    "frame_rate": {"frame_rate": 8.0},
}
"""A hard value of each axis by itself; everything else as by default, except where an axis needs another one."""


def settings() -> dict[str, Mapping[str, Any]]:
    """Return the arguments of the world by name: every level, then every axis."""
    levels: dict[str, Mapping[str, Any]] = {
        f"level {number}, {name}": {"level": number} for number, name in enumerate(LEVEL_NAMES)
    }
    # Level 3 with its zoom turned off has the default of every axis.
    return levels | {
        f"{' '.join(f'{key}={value:g}' for key, value in axes.items())}": {"level": 3, "zoom": 1.0, **axes}
        for axes in HARD_AXES.values()
    }


def peers_report(found: Mapping[str, Mapping[str, np.ndarray]], films: int, command: str) -> str:
    """Return the page with the AUC of every tracker by setting.

    Args:
        found: AUC of every film, by setting and tracker.
        films: Number of films of each setting.
        command: Command that wrote the results.
    """
    rows, behind = [], []
    for name, aucs in found.items():
        means = [f"{aucs[tracker].mean():.3f}" for tracker in (OURS, *PEERS)]
        difference = paired_difference(aucs[OURS], aucs["csrt"])
        rows.append([name, *means, f"{difference.value:+.3f} [{difference.low:+.3f}, {difference.high:+.3f}]"])
        if difference.value <= 0.0:
            behind.append(name)
    overall = [f"{bootstrap_mean(np.concatenate([a[t] for a in found.values()])).value:.3f}" for t in (OURS, *PEERS)]
    rows.append(["all", *overall, ""])
    verdict = f"It is behind CSRT on {', '.join(behind)}." if behind else "It is ahead of CSRT in every row."
    return (
        "# Color trackers beside correlation filters\n\n"
        f"Area under the success curve of `{OURS}` and of OpenCV's CSRT and KCF (contrib wheel), on every level of "
        "[`ColorTracking-v0`](../environments/ColorTracking-v0.md) and on a hard value of every axis by itself. All "
        f"trackers see the same films and start from the true box of the first frame. {verdict}\n\n"
        f"{as_markdown(Grid(['films', OURS, *PEERS, 'difference to csrt'], rows, 1)).strip()}\n\n"
        f"Means over {films} films of test seeds, 200 frames each; the difference is paired by film, with its 95 % "
        f"bootstrap interval. CSRT and KCF have the parameters of OpenCV {cv2.__version__}, which no search changed; "
        f"ours were chosen on tune seeds, see [the guide](../color.md). Written by `{command}`.\n"
    )


def _run(setting: Mapping[str, Any], seed: int, path: Path) -> None:
    import servotrack  # noqa: F401 - a worker process has to register the ids

    cv2.setNumThreads(1)
    seen = film(seed, **setting)
    aucs = {name: track(color_tracker(name), seen).auc for name in (OURS, *PEERS)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(aucs), encoding="utf-8")


def _compare(given: argparse.Namespace) -> None:
    folder = given.output / code_version()
    chosen = settings()
    paths = {
        name: [folder / f"{number}-{seed}.json" for seed in scored_seeds(given.films)]
        for number, name in enumerate(chosen)
    }
    tasks = [
        delayed(_run)(setting, seed, path)
        for name, setting in chosen.items()
        for seed, path in zip(scored_seeds(given.films), paths[name], strict=True)
        if not path.exists()
    ]
    console = Console(stderr=True)
    for done, _ in enumerate(in_workers(iter(tasks), given.jobs), start=1):
        if done % 20 == 0 or done == len(tasks):
            console.print(f"{done} of {len(tasks)} films")
    found = {}
    for name, files in paths.items():
        stored = [json.loads(path.read_text(encoding="utf-8")) for path in files]
        found[name] = {tracker: np.array([aucs[tracker] for aucs in stored]) for tracker in (OURS, *PEERS)}
    page = peers_report(found, given.films, f"scripts/color-peers --films {given.films}")
    print(page)
    if given.write:
        with atomic_path(given.write) as temporary:
            temporary.write_text(page, encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Run all films that the folder does not hold yet, print the page and write it to `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/color-peers", description=__doc__)
    parser.add_argument("--films", type=int, default=20, help="films of each level and axis (default 20)")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1 for all processors")
    parser.add_argument("--output", type=Path, default=Path("results/color-peers"), help="folder of finished films")
    parser.add_argument("--write", type=Path, help="also write the page to this file")
    given = parser.parse_args(arguments)
    if given.films < 1:
        parser.error(f"--films must be at least 1, got {given.films}")
    with program("finished films are kept; run the same command again"):
        _compare(given)


if __name__ == "__main__":
    main()
