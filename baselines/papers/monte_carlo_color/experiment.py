"""Experiment of Zhang and Li (2008): its scenarios as films, and all trackers run over them, with results on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from rich.progress import Progress

from servotrack.baselines.agents.color.catalog import ColorTracker, color_tracker
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.boxes import box_points
from servotrack.baselines.papers.parts import Arrays, PartTask, compute_parts, read_part, setting_of
from servotrack.baselines.tuning.color_films import film, track
from servotrack.envs.track.color.config import PAPER_SCENARIOS
from servotrack.estimators.color import BoxEstimate, KernelMeanShift
from servotrack.estimators.color.contract import checked_frame
from servotrack.estimators.color.mean_shift import MeanShiftState
from servotrack.estimators.types import Array

Method = tuple[str, Mapping[str, Any]]

PAPER, PLUS, PARTICLES, MEAN_SHIFT = "Monte Carlo", "Monte Carlo plus", "particle filter", "kernel mean shift"
HUES = "OpenCV meanShift"
ONE_SCALE = "one scale"
TRACKERS: dict[str, Method] = {
    PAPER: ("monte-carlo-color", {}),
    PLUS: ("monte-carlo-color-plus", {}),
    PARTICLES: ("color-particle-filter", {}),
    MEAN_SHIFT: ("kernel-mean-shift", {}),
    HUES: ("opencv-meanshift", {}),
    "OpenCV CamShift": ("opencv-camshift", {}),
}
"""Compared methods: name to tracker and parameters."""
MIL = "MIL"
SLOW_TRACKERS: dict[str, Method] = {MIL: ("mil", {})}
"""Methods that run only on a tenth of the films."""
DEVIATIONS = (0.02, 0.05, 0.1, 0.2, 0.4)
THRESHOLDS = (0.0, 0.8, 0.9, 0.95, 0.98, 1.0)
SAMPLES = (50, 200, 800)
ALWAYS, NEVER = 0.0, 1.0
"""Thresholds of the update that always and that never let it happen."""
BOX_AXES = ("sigma_0", "alpha", "spread")
FOLLOWING_AXES = ("sigma_0", "spread")
"""Assumptions that matter wherever a target is followed."""
SPREAD = 10.0
"""Standard deviation of the candidates' places in the main tables, px."""
SPREADS = (SPREAD / 2.0, SPREAD, SPREAD * 2.0)
BOX_SCENARIOS = ("occlusion", "light")
"""Scenarios about which claims on the update are made; only there alpha is varied."""
DEFORMED: Mapping[str, Any] = {"turning": 1.0, "tilt": 0.4}
"""Axes of films in which the head turns until the face is hidden and rolls: the paper's deformation."""


def deviation_name(value: float, spread: float = SPREAD) -> str:
    """Return the name of the paper's tracker with another sigma_0, and with candidates that spread by `spread` px."""
    return f"sigma_0 = {value:g}" + ("" if spread == SPREAD else f", spread = {spread:g}")


def threshold_name(value: float) -> str:
    """Return the name of the paper's tracker with another threshold of the update; 1 never updates."""
    return f"threshold = {value:g}"


def samples_name(value: int) -> str:
    """Return the name of the paper's tracker with another number of samples."""
    return f"n = {value}"


def box_name(at: Mapping[str, Any], threshold: float = 0.9) -> str:
    """Return the name of the paper's tracker at a point of the box of open assumptions.

    Args:
        at: Values of `BOX_AXES`.
        threshold: Threshold of the update. A tracker that never updates has no alpha.
    """
    alpha = "any" if threshold == NEVER else format(at["alpha"], "g")
    return f"sigma_0 {at['sigma_0']:g}, alpha {alpha}, spread {at['spread']:g}, {threshold:g}"


def _boxed() -> dict[str, Method]:
    """Return the paper's tracker at all points of the box, and what always and what never updates there."""
    found: dict[str, Method] = {}
    for at in box_points("monte_carlo_color", BOX_AXES):
        for threshold in (0.9, ALWAYS, NEVER):
            setting = {
                "distance_deviation": at["sigma_0"], "update_rate": at["alpha"], "update_threshold": threshold,
                "center_deviation": at["spread"],
            }  # fmt: skip
            found[box_name(at, threshold)] = ("monte-carlo-color", setting)
    return found


VARIANTS: dict[str, Method] = {
    **{deviation_name(v): ("monte-carlo-color", {"distance_deviation": v}) for v in DEVIATIONS},
    **{threshold_name(v): ("monte-carlo-color", {"update_threshold": v}) for v in THRESHOLDS},
    **{samples_name(v): ("monte-carlo-color", {"samples": v}) for v in SAMPLES},
}
"""Variants of the paper's tracker with one value changed."""
BOXED: dict[str, Method] = _boxed()
FOLLOWING: dict[str, Method] = {
    deviation_name(float(at["sigma_0"]), spread): (
        "monte-carlo-color", {"distance_deviation": at["sigma_0"], "center_deviation": spread},
    )
    for at in box_points("monte_carlo_color", FOLLOWING_AXES[:1])
    for spread in SPREADS
}  # fmt: skip
"""The paper's tracker with every sigma_0 and spread; alpha is varied only where claims are about the update."""
METHODS: dict[str, Method] = {**TRACKERS, **SLOW_TRACKERS, **VARIANTS, **BOXED, **FOLLOWING}


class Measures(NamedTuple):
    """Measurements of one method in one scenario, one row per film.

    Attributes:
        iou: Overlap of answered and true box in every frame, shape (films, F).
        center_error: Distance of their centers in every frame, shape (films, F), px.
        size: Square root of the area ratio of answered and true box, shape (films, F).
    """

    iou: Array
    center_error: Array
    size: Array


def scored_seeds(count: int) -> list[int]:
    """Return test seeds from the second one on; the films of the first were inspected during development."""
    return seeds.take("test", count, first=1)


def plan(runs: int) -> list[tuple[int, int, tuple[str, ...]]]:
    """Return the films as level, seed and methods that run over them. Slow trackers run on a tenth of the films.

    Args:
        runs: Films per scenario.
    """
    few = max(1, runs // 10)
    fast = dict.fromkeys((*TRACKERS, *VARIANTS, *FOLLOWING))
    return [
        (
            level,
            seed,
            (*fast, *(BOXED if name in BOX_SCENARIOS else ()), *(SLOW_TRACKERS if number < few else ())),
        )
        for level, name in enumerate(PAPER_SCENARIOS)
        for number, seed in enumerate(scored_seeds(runs))
    ]


def deformed_plan(runs: int) -> list[tuple[int, int, tuple[str, ...]]]:
    """Return the films with a deformed head, as `plan` does; they belong to `DEFORMED`."""
    return [(0, seed, (PAPER, PLUS, MEAN_SHIFT, *FOLLOWING)) for seed in scored_seeds(runs)]


def run_all(
    films: Sequence[tuple[int, int, tuple[str, ...]]],
    folder: Path,
    progress: Progress,
    jobs: int = -1,
    env_kwargs: Mapping[str, Any] | None = None,
) -> dict[str, dict[str, Measures]]:
    """Run all methods over all films. Results that `folder` already contains are read.

    Args:
        films: Films from `plan`.
        folder: Folder with one file per film.
        progress: Progress display that gets a bar.
        jobs: Processes; -1 for all processors.
        env_kwargs: Arguments of the environment besides its level.

    Returns:
        Measurements by scenario and method, in the order of the films.

    Raises:
        ResultsError: A file has another setting or version, or the folder cannot be written.
    """
    world = dict(env_kwargs or {})
    paths = [folder / PAPER_SCENARIOS[level] / f"{seed}.npz" for level, seed, _ in films]
    todo = [(entry, path) for entry, path in zip(films, paths, strict=True) if not path.exists()]
    bar = progress.add_task("films", total=len(films), completed=len(films) - len(todo))
    tasks = [PartTask(path, _setting(*entry, world), _run, (*entry, world)) for entry, path in todo]
    for _ in compute_parts(tasks, jobs):
        progress.advance(bar)
    found: dict[str, dict[str, list[Measures]]] = {}
    for entry, path in zip(films, paths, strict=True):
        scenario = found.setdefault(PAPER_SCENARIOS[entry[0]], {})
        for method, measures in _read(path, *entry, world).items():
            scenario.setdefault(method, []).append(measures)
    return {
        name: {method: Measures(*map(np.stack, zip(*rows, strict=True))) for method, rows in methods.items()}
        for name, methods in found.items()
    }


def median_steps(names: Sequence[str], seed: int, repetitions: int = 8) -> dict[str, float]:
    """Return the duration of a step of each method on one thread, s.

    It is the median over the steps of a film, and the smallest of these medians over several passes.

    Args:
        names: Names in `METHODS`.
        seed: Seed of the film.
        repetitions: Passes over the film. Slow trackers get one.
    """
    import cv2

    seen = film(seed, horizon=60)
    found = dict.fromkeys(names, np.inf)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        # All methods in turn, so that other load on the machine affects them alike.
        for repetition in range(repetitions):
            for name in names:
                if repetition == 0 or name not in SLOW_TRACKERS:
                    tracker, parameters = METHODS[name]
                    seconds = track(color_tracker(tracker, **parameters), seen).seconds
                    found[name] = min(found[name], float(np.median(seconds)))
    finally:
        cv2.setNumThreads(threads)
    return found


@dataclass(frozen=True)
class OneScale(KernelMeanShift):
    """Kernel mean shift that keeps the scale: one search per frame instead of three."""

    def step(self, state: MeanShiftState, frame: ArrayLike) -> tuple[MeanShiftState, BoxEstimate]:
        """Search from the last position at the last scale; arguments as in `KernelMeanShift.step`."""
        last = state.pose
        center, similarity = self._climb(checked_frame(frame, last.shape), state, last.scale)
        pose = last._replace(center=last.within(center))
        return state._replace(pose=pose), BoxEstimate(pose.box, similarity)


def film_steps(seeds_of_films: Sequence[int], repetitions: int = 3) -> dict[str, Array]:
    """Return the median duration of a step on each film, least over several passes, on one thread, s.

    Args:
        seeds_of_films: Seeds of the films.
        repetitions: Passes over each film.

    Returns:
        Durations of the paper's tracker, the particle filter, and the kernel mean shift with and without ("one scale")
        search for the scale. Shape (films,) each.
    """
    import cv2

    trackers: dict[str, ColorTracker] = {
        name: color_tracker(METHODS[name][0], **METHODS[name][1]) for name in (PAPER, PARTICLES, MEAN_SHIFT)
    }
    trackers[ONE_SCALE] = OneScale()
    found: dict[str, list[float]] = {name: [] for name in trackers}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for seed in seeds_of_films:
            seen = film(seed, horizon=60)
            for name, tracker in trackers.items():
                found[name].append(min(float(np.median(track(tracker, seen).seconds)) for _ in range(repetitions)))
    finally:
        cv2.setNumThreads(threads)
    return {name: np.array(values) for name, values in found.items()}


def _run(level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any]) -> Arrays:
    import cv2

    # One process runs per processor, so each uses one thread.
    cv2.setNumThreads(1)
    seen = film(seed, level=level, **world)
    arrays = {}
    for name in methods:
        tracker, parameters = METHODS[name]
        done = track(color_tracker(tracker, **parameters), seen)
        size = np.sqrt(done.boxes[:, 2] * done.boxes[:, 3] / (seen.boxes[:, 2] * seen.boxes[:, 3]))
        arrays[name] = np.stack([done.iou, done.center_error, size])
    return arrays


def _read(path: Path, level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any]) -> dict[str, Measures]:
    stored = read_part(path, _setting(level, seed, methods, world))
    return {name: Measures(*stored[name]) for name in methods}


def _setting(level: int, seed: int, methods: Sequence[str], world: Mapping[str, Any]) -> str:
    """Settings that a film's results depend on, in one line."""
    chosen = {name: METHODS[name] for name in methods}
    return setting_of(level=level, seed=seed, world=dict(world), methods=chosen)
