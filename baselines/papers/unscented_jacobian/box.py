"""Box of open assumptions of Zhang (2011): all its comparisons at every combination of noises and windows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from servotrack.baselines.papers.boxes import Effect, Point, Value, box_points
from servotrack.baselines.papers.claims import paired_effect
from servotrack.baselines.papers.parts import parts_of_seeds
from servotrack.baselines.papers.unscented_jacobian import experiment
from servotrack.baselines.papers.unscented_jacobian.experiment import POSITIONING, TRACKING, WORLD, Variances
from servotrack.estimators.types import Array

PAPER_NAME = "unscented_jacobian"
NOISES = ("process_variance", "measurement_variance", "pixel_noise")
"""Assumptions that a run depends on; `window` only chooses its steps."""
HEAVY = ("noise_kind", "pf_likelihood")
RANDOM_ELLIPSES: Mapping[str, Any] = {**WORLD, "target": "ellipse"}
NOT_GAUSSIAN: Mapping[str, Mapping[str, Any]] = {
    "laplace": {"pixel_noise": 2.0, "noise_kind": "laplace"},
    "outliers": {"pixel_noise": 0.5, "outlier_rate": 0.05, "outlier_size": 30.0},
}
"""Noises with heavy tails, by their names in assumptions.yaml."""
WINDOWS = {"first period": "transient", "after 3 s": "steady"}
"""Attributes of a `Run` by the window's name in assumptions.yaml."""
METHODS = ("KF", "PF", "UKF", "UKF as printed", "KF without J_t", "fixed")
FASTER = "KF x10"
JACOBIANS = ("KF", "PF", "UKF", "UKF as printed")
EPISODES = 20
"""Episodes at each point."""


class Box:
    """Results at all points, computed or read.

    Args:
        folder: Folder of the finished parts.
        progress: Progress display that gets a bar.
        episodes: Episodes at each point.
    """

    def __init__(self, folder: Path, progress: Progress, episodes: int = EPISODES) -> None:
        self.episodes = episodes
        self._folder, self._progress = folder, progress
        noises = box_points(PAPER_NAME, NOISES)
        bar = progress.add_task("box of assumptions", total=len(noises) + len(NOT_GAUSSIAN) + 1)
        self._ellipses = []
        for point in noises:
            self._ellipses.append((point, self._runs(_name(point), partial(_ellipse, point))))
            progress.advance(bar)
        self._heavy = {}
        for name, noise in NOT_GAUSSIAN.items():
            self._heavy[name] = self._runs(name, partial(_heavy, noise))
            progress.advance(bar)
        self.at_rest = self._runs("at-rest", _at_rest)
        progress.advance(bar)

    def _runs(self, name: str, compute: Callable[[int], Mapping[str, Any]]) -> dict[str, Array]:
        """Results of all episodes, by name, first axis the episodes."""
        rows = parts_of_seeds(
            self._folder / name, self.episodes, compute,
            point=name, gain=experiment.GAIN, probe=experiment.PROBE, world=dict(WORLD),
            prior=experiment.INITIAL_VARIANCE, heavy={key: dict(value) for key, value in NOT_GAUSSIAN.items()},
        )  # fmt: skip
        return {key: np.array([row[key] for row in rows], np.float64) for key in rows[0]}

    def differences(self, first: str, second: str) -> tuple[Point, ...]:
        """Points of "the first error is smaller than the second", paired by episode, mm."""
        points = []
        for at, found in self._ellipses:
            for window, attribute in WINDOWS.items():
                one, other = (found[f"{name}/{attribute}"] for name in (first, second))
                effect = self._effect(one, other, f"{window}, {first} - {second}")
                points.append(Point({**at, "window": window}, (effect,)))
        return tuple(points)

    def jacobians(self, first: str, second: str, entries: int) -> tuple[Point, ...]:
        """Points of "the first Jacobian is nearer to the analytic one", %.

        Args:
            first: Algorithm.
            second: Algorithm.
            entries: 0 for J_theta, 1 for J_t.
        """
        points = []
        for at, found in self._ellipses:
            one, other = (found[f"{name}/jacobian"][:, entries] for name in (first, second))
            measured = f"error of the Jacobian, {first} - {second}"
            points.append(Point(at, (paired_effect(one, other, "% of the norm", measured, 100.0),)))
        return tuple(points)

    def heavy_tails(self) -> tuple[Point, ...]:
        """Points of "where noise is not Gaussian the PF's error is smaller than the KF's", mm."""
        names = {"normal": "PF", "Student-t": "PF, Student-t"}
        points = []
        for at in box_points(PAPER_NAME, HEAVY):
            found, name = self._heavy[str(at["noise_kind"])], names[str(at["pf_likelihood"])]
            effect = self._effect(found[name], found["KF"], f"first period, {name} - KF, {at['noise_kind']}")
            points.append(Point(at, (effect,)))
        return tuple(points)

    def _effect(self, first: Array, second: Array, measured: str) -> Effect:
        return paired_effect(first, second, "mm", f"tracking error, {measured}", 1e3)


def _name(point: Mapping[str, Value]) -> str:
    return "-".join(f"{value:g}" for value in point.values())


def _ellipse(point: Mapping[str, Value], seed: int) -> dict[str, Any]:
    """Errors of all methods on a random ellipse, in both windows, and of their Jacobians on one stream."""
    world = {**RANDOM_ELLIPSES, "pixel_noise": point["pixel_noise"]}
    variances = Variances(float(point["process_variance"]), float(point["measurement_variance"]))
    methods = {name: experiment.estimator(name, variances=variances) for name in METHODS}
    methods[FASTER] = experiment.estimator("KF", 10.0, variances=variances)
    jacobian = experiment.initial_jacobian(TRACKING, world, seed)
    found: dict[str, Any] = {}
    for name, method in methods.items():
        run = experiment.run(TRACKING, method, seed, world, jacobian)
        found |= {f"{name}/{attribute}": getattr(run, attribute) for attribute in WINDOWS.values()}
    for name, error in experiment.jacobian_errors(JACOBIANS, variances, seed, world).items():
        found[f"{name}/jacobian"] = error
    return found


def _heavy(noise: Mapping[str, Any], seed: int) -> dict[str, float]:
    world = {**RANDOM_ELLIPSES, **noise}
    jacobian = experiment.initial_jacobian(TRACKING, world, seed)
    return {
        name: experiment.run(TRACKING, experiment.estimator(name), seed, world, jacobian).transient
        for name in ("KF", "PF", "PF, Student-t")
    }


def _at_rest(seed: int) -> dict[str, float]:
    """Mean errors before a target at rest anywhere, from a Jacobian learned before the paper's target."""
    learned = experiment.initial_jacobian(POSITIONING, WORLD, seed)
    world = {**WORLD, "target": "point"}
    found: dict[str, float] = {}
    for name in ("KF", "UKF", "fixed"):
        run = experiment.run(POSITIONING, experiment.estimator(name), seed, world, learned)
        length = experiment.PERIOD * run.error.size
        found |= {name: run.transient, f"{name}/end": run.error[-1], f"{name}/arrival": min(run.arrival, length)}
    return found
