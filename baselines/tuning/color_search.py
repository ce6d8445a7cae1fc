"""Coordinate search on tune seeds that chose the color trackers' values, the same for all.

    python -m servotrack.baselines.tuning.color_search monte-carlo-color
    python -m servotrack.baselines.tuning.color_search --robust monte-carlo-color-plus

Protocol: start at the tracker's present values. For one parameter after the other, try the values of its grid on all
films (six scenarios times `--episodes` tune seeds) and keep the value of the highest mean AUC. Repeat `--rounds` times.
With `--robust`, the films are those of all eight levels, and the value of the highest AUC on its worst level is kept.
The printed number of trials counts every setting that was run over all films. Test seeds are never used.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from joblib import delayed

from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.agents.color.tuning_grid import EPISODES, GRIDS, ROBUST_GRIDS
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.running.stopping import program
from servotrack.baselines.running.workers import in_workers
from servotrack.baselines.tuning.color_films import Film, film, track
from servotrack.envs.track.color.config import LEVEL_NAMES, PAPER_SCENARIOS


def mean_auc(
    name: str, settings: Sequence[Mapping[str, Any]], episodes: int, jobs: int = -1, levels: int = len(PAPER_SCENARIOS)
) -> np.ndarray:
    """Mean AUC of several settings on the same films, by level.

    Args:
        name: Name of the tracker.
        settings: Parameters of each.
        episodes: Tune seeds of every scenario.
        jobs: Processes; -1 for all processors.
        levels: Number of levels, the first ones.

    Returns:
        Shape (settings, levels).
    """
    tasks = [(level, seed) for level in range(levels) for seed in seeds.take("tune", episodes)]
    found = list(in_workers((delayed(_on_film)(name, settings, *task) for task in tasks), jobs, ordered=True))
    return np.array(found).reshape(levels, episodes, len(settings)).mean(axis=1).T


def search(name: str, episodes: int, rounds: int = 1, jobs: int = -1, robust: bool = False) -> dict[str, Any]:
    """Coordinate search by the protocol above.

    Returns:
        `parameters`, `auc` of each scenario, and `trials`.
    """
    grids = ROBUST_GRIDS if robust else GRIDS
    levels = LEVEL_NAMES if robust else PAPER_SCENARIOS
    best: dict[str, Any] = {}
    trials, score = 0, None
    for _ in range(rounds):
        before = dict(best)
        for parameter, values in grids[name].items():
            settings = [{**best, parameter: value} for value in values]
            scores = mean_auc(name, settings, episodes, jobs, len(levels))
            judged = scores.min(axis=1) if robust else scores.mean(axis=1)
            trials += len(settings)
            winner = int(judged.argmax())
            print(parameter, {v: round(float(s), 4) for v, s in zip(values, judged, strict=True)}, flush=True)
            best, score = settings[winner], scores[winner]
        if best == before:
            break
    assert score is not None
    return {"parameters": best, "auc": dict(zip(levels, score.tolist(), strict=True)), "trials": trials}


def _on_film(name: str, settings: Sequence[Mapping[str, Any]], level: int, seed: int) -> list[float]:
    import servotrack  # noqa: F401 - a worker process has to register the ids

    seen = _film(seed, level)
    return [track(color_tracker(name, **parameters), seen).auc for parameters in settings]


@lru_cache(maxsize=32)
def _film(seed: int, level: int) -> Film:
    """Films are kept: every parameter is tried on the same ones."""
    return film(seed, level=level)


def main() -> None:
    """The command line above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="trackers (default: all that have a grid)")
    parser.add_argument("--robust", action="store_true", help="all levels, judged by the worst one")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="tune seeds of each scenario")
    parser.add_argument("--rounds", type=int, default=1, help="of the search")
    parser.add_argument("--jobs", type=int, default=-1, help="processes")
    arguments = parser.parse_args()
    known = ROBUST_GRIDS if arguments.robust else GRIDS
    for name in set(arguments.names) - set(known):
        parser.error(f"names must be among {', '.join(known)}, got {name!r}")
    with program("run the same command again"):
        for name in arguments.names or known:
            print(name)
            print(search(name, arguments.episodes, arguments.rounds, arguments.jobs, arguments.robust))


if __name__ == "__main__":
    main()
