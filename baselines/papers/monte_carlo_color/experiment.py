"""Paper 001's experiment: its scenarios as films, trackers and variants of the paper's run over them, kept on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from rich.progress import Progress

from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.reporting.files import ResultsError, atomic_path
from servotrack.baselines.tuning.color_films import film, track
from servotrack.envs.track.color.config import LEVEL_NAMES
from servotrack.estimators.types import Array

Method = tuple[str, Mapping[str, Any]]

PAPER, PLUS, PARTICLES, MEAN_SHIFT = "Monte Carlo", "Monte Carlo plus", "particle filter", "kernel mean shift"
HUES = "OpenCV meanShift"
TRACKERS: dict[str, Method] = {
    PAPER: ("monte-carlo-color", {}),
    PLUS: ("monte-carlo-color-plus", {}),
    PARTICLES: ("color-particle-filter", {}),
    MEAN_SHIFT: ("kernel-mean-shift", {}),
    HUES: ("opencv-meanshift", {}),
    "OpenCV CamShift": ("opencv-camshift", {}),
}
"""What is compared, by name: tracker and parameters."""
MIL = "MIL"
SLOW_TRACKERS: dict[str, Method] = {MIL: ("mil", {})}
"""Compared on a few films only."""
DEVIATIONS = (0.02, 0.05, 0.1, 0.2, 0.4)
THRESHOLDS = (0.0, 0.8, 0.9, 0.95, 0.98, 1.0)
SAMPLES = (50, 200, 800)


def deviation_name(value: float) -> str:
    """Name of the paper's tracker with another sigma_0."""
    return f"sigma_0 = {value:g}"


def threshold_name(value: float) -> str:
    """Name of the paper's tracker with another threshold of the update; 1 never updates."""
    return f"threshold = {value:g}"


def samples_name(value: int) -> str:
    """Name of the paper's tracker with another number of samples."""
    return f"n = {value}"


VARIANTS: dict[str, Method] = {
    **{deviation_name(v): ("monte-carlo-color", {"distance_deviation": v}) for v in DEVIATIONS},
    **{threshold_name(v): ("monte-carlo-color", {"update_threshold": v}) for v in THRESHOLDS},
    **{samples_name(v): ("monte-carlo-color", {"samples": v}) for v in SAMPLES},
}
"""The paper's tracker with one value changed."""
METHODS: dict[str, Method] = {**TRACKERS, **SLOW_TRACKERS, **VARIANTS}


class Measures(NamedTuple):
    """What is measured of a method in a scenario, one row for each film.

    Attributes:
        iou: Of every frame, shape (films, F).
        center_error: Of every frame, shape (films, F), px.
        size: Root of the answered box's area over that of the true one. Shape (films, F).
    """

    iou: Array
    center_error: Array
    size: Array


def judged_seeds(count: int) -> list[int]:
    """Seeds to judge on: those from the second test seed on, for the first one's films were looked at before."""
    return seeds.take("test", count, first=1)


def plan(runs: int) -> list[tuple[int, int, tuple[str, ...]]]:
    """Films as level, seed and the methods that are run over them; a slow tracker gets a tenth of them.

    Args:
        runs: Films of each scenario.
    """
    few = max(1, runs // 10)
    fast = (*TRACKERS, *VARIANTS)
    return [
        (level, seed, (*fast, *SLOW_TRACKERS) if number < few else fast)
        for level in range(len(LEVEL_NAMES))
        for number, seed in enumerate(judged_seeds(runs))
    ]


def run_all(
    films: Sequence[tuple[int, int, tuple[str, ...]]],
    folder: Path,
    progress: Progress,
    jobs: int = -1,
    env_kwargs: Mapping[str, Any] | None = None,
) -> dict[str, dict[str, Measures]]:
    """All methods over all films; those that `folder` holds already are read.

    Args:
        films: As `plan` makes them.
        folder: One file for each film.
        progress: Shows a bar.
        jobs: Processes; -1 for all processors.
        env_kwargs: Arguments of the world besides its level.

    Returns:
        Measures by scenario and method, in the order of the films.

    Raises:
        ResultsError: A file of another setting or version, or a folder that cannot be written.
    """
    world = dict(env_kwargs or {})
    paths = [folder / LEVEL_NAMES[level] / f"{seed}.npz" for level, seed, _ in films]
    todo = [(entry, path) for entry, path in zip(films, paths, strict=True) if not path.exists()]
    bar = progress.add_task("films", total=len(films), completed=len(films) - len(todo))
    tasks = (delayed(_run)(*entry, world, path) for entry, path in todo)
    for _ in Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks):
        progress.advance(bar)
    found: dict[str, dict[str, list[Measures]]] = {}
    for entry, path in zip(films, paths, strict=True):
        scenario = found.setdefault(LEVEL_NAMES[entry[0]], {})
        for method, measures in _read(path, *entry, world).items():
            scenario.setdefault(method, []).append(measures)
    return {
        name: {method: Measures(*map(np.stack, zip(*rows, strict=True))) for method, rows in methods.items()}
        for name, methods in found.items()
    }


def median_steps(names: Sequence[str], seed: int, repetitions: int = 8) -> dict[str, float]:
    """Median duration of a step of each method on one thread, s: the least of several passes over a film."""
    import cv2

    seen = film(seed, horizon=60)
    found = dict.fromkeys(names, np.inf)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        # In turn, so that a machine that is busy for a while slows all of them down.
        for repetition in range(repetitions):
            for name in names:
                if repetition == 0 or name not in SLOW_TRACKERS:
                    tracker, parameters = METHODS[name]
                    seconds = track(color_tracker(tracker, **parameters), seen).seconds
                    found[name] = min(found[name], float(np.median(seconds)))
    finally:
        cv2.setNumThreads(threads)
    return found


def _run(level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any], path: Path) -> None:
    import cv2

    import servotrack  # noqa: F401 - a worker process has to register the ids

    # As many processes as processors run side by side.
    cv2.setNumThreads(1)
    seen = film(seed, level=level, **world)
    arrays = {}
    for name in methods:
        tracker, parameters = METHODS[name]
        done = track(color_tracker(tracker, **parameters), seen)
        size = np.sqrt(done.boxes[:, 2] * done.boxes[:, 3] / (seen.boxes[:, 2] * seen.boxes[:, 3]))
        arrays[name] = np.stack([done.iou, done.center_error, size])
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        arrays["setting"] = np.array(_setting(level, seed, methods, world))
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _read(path: Path, level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any]) -> dict[str, Measures]:
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path} cannot be read ({error}); delete it, and the next call makes it anew") from error
    if str(stored.get("setting")) != _setting(level, seed, methods, world):
        raise ResultsError(f"{path} holds runs of another setting or version; choose another --output, or delete it")
    return {name: Measures(*stored[name]) for name in methods}


def _setting(level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any]) -> str:
    """All that a film's numbers depend on, in one line."""
    chosen = {name: METHODS[name] for name in methods}
    setting = {"version": code_version(), "level": level, "seed": seed, "world": dict(world), "methods": chosen}
    return json.dumps(setting, sort_keys=True)
