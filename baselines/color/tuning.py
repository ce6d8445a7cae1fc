"""How the color trackers' values were chosen: coordinate search on tune seeds, the same for all.

    python -m servotrack.baselines.color.tuning monte-carlo-color --episodes 4

Protocol: start from the class's defaults; for one parameter after the other try the values of `GRIDS` on all films, six
scenarios times `--episodes` tune seeds; keep the one of the highest mean AUC; go round `--rounds` times. The number of
trials that is printed counts every setting that was run over all films. Test seeds are never looked at.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from servotrack.baselines import seeds
from servotrack.baselines.color.films import Film, film, track
from servotrack.baselines.color.trackers import color_tracker
from servotrack.envs.track.color.config import LEVEL_NAMES

_HUES: Mapping[str, Sequence[Any]] = {
    "saturation": (0, 30, 60, 90, 120, 150),
    "bins": (16, 32, 64, 128),
    "darkest": (0, 32, 64, 96),
}
GRIDS: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "monte-carlo-color": {
        "distance_deviation": (0.03, 0.05, 0.08, 0.12, 0.2),
        "update_threshold": (0.8, 0.9, 0.95, 0.98),
        "center_deviation": (4.0, 7.0, 10.0, 14.0),
        "scale_deviation": (0.01, 0.02, 0.04, 0.08),
        "update_rate": (0.01, 0.02, 0.05, 0.1),
    },
    "color-particle-filter": {
        "distance_deviation": (0.02, 0.035, 0.06, 0.1, 0.15),
        "update_threshold": (0.8, 0.9, 0.95, 0.98),
        "center_deviation": (3.0, 5.0, 8.0, 12.0),
        "scale_deviation": (0.01, 0.02, 0.04, 0.08),
        "damping": (0.0, 0.5, 0.8, 1.0),
        "update_rate": (0.01, 0.02, 0.05, 0.1),
    },
    "kernel-mean-shift": {
        "scale_mixing": (0.0, 0.05, 0.1, 0.2, 0.4),
        "scale_step": (0.05, 0.1, 0.2),
        "bins": (4, 8, 16),
    },
    "opencv-meanshift": {
        "saturation": (0, 30, 60, 90, 120, 150),
        "bins": (16, 32, 64, 128),
        "darkest": (0, 32, 64, 96),
    },
    "opencv-camshift": {"saturation": (0, 30, 60, 90, 120, 150), "bins": (16, 32, 64, 128), "darkest": (0, 32, 64, 96)},
    "monte-carlo-color-plus": {
        "loyalty": (0.5, 0.7, 0.85, 1.0),
        "gradient_share": (0.45, 0.6, 0.7),
        "color_share": (0.1, 0.2, 0.3),
        "scale_deviation": (0.03, 0.05, 0.08),
        "sharpness": (30.0, 60.0, 120.0),
        "center_deviation": (0.16, 0.22, 0.3),
        "hidden_below": (0.45, 0.55, 0.65),
        "update_rate": (0.03, 0.06, 0.1),
        "grid": (4, 5, 7),
    },
}
"""What is tried, for each tracker that has values to choose. A threshold of 1 would leave out eq. (12) of the paper."""


def mean_auc(name: str, settings: Sequence[Mapping[str, Any]], episodes: int, jobs: int = -1) -> np.ndarray:
    """Mean AUC of several settings on the same films, by scenario.

    Args:
        name: Of the tracker.
        settings: Parameters of each.
        episodes: Tune seeds of every scenario.
        jobs: Processes; -1 for all processors.

    Returns:
        Shape (settings, 6).
    """
    tasks = [(level, seed) for level in range(len(LEVEL_NAMES)) for seed in seeds.take("tune", episodes)]
    found = Parallel(n_jobs=jobs)(delayed(_on_film)(name, settings, *task) for task in tasks)
    return np.array(found).reshape(len(LEVEL_NAMES), episodes, len(settings)).mean(axis=1).T


def search(name: str, episodes: int, rounds: int = 1, jobs: int = -1) -> dict[str, Any]:
    """Coordinate search by the protocol above.

    Returns:
        `parameters`, `auc` of each scenario, and `trials`.
    """
    best: dict[str, Any] = {}
    trials, score = 0, None
    for _ in range(rounds):
        before = dict(best)
        for parameter, values in GRIDS[name].items():
            settings = [{**best, parameter: value} for value in values]
            scores = mean_auc(name, settings, episodes, jobs)
            trials += len(settings)
            winner = int(scores.mean(axis=1).argmax())
            print(
                parameter, {v: round(float(s), 4) for v, s in zip(values, scores.mean(axis=1), strict=True)}, flush=True
            )
            best, score = settings[winner], scores[winner]
        if best == before:
            break
    assert score is not None
    return {"parameters": best, "auc": dict(zip(LEVEL_NAMES, score.tolist(), strict=True)), "trials": trials}


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
    parser.add_argument("names", nargs="*", default=list(GRIDS))
    parser.add_argument("--episodes", type=int, default=6, help="tune seeds of each scenario")
    parser.add_argument("--rounds", type=int, default=1, help="of the search")
    parser.add_argument("--jobs", type=int, default=-1, help="processes")
    arguments = parser.parse_args()
    for name in arguments.names:
        print(name)
        print(search(name, arguments.episodes, arguments.rounds, arguments.jobs))


if __name__ == "__main__":
    main()
