"""Experiment of Jiang and Zhou (2016): simulation at falling signal-to-noise ratios, a sea trial, an hour of noise."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

from servotrack.baselines.agents.sonar.catalog import BearingTracker, sonar_tracker
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.papers.hmm_sonar.scores import RecordScores, score_tracks
from servotrack.baselines.papers.parts import Arrays, PartTask, compute_parts, read_part, setting_of
from servotrack.envs.track.sonar.array_model import SonarModel, scene_model_of
from servotrack.envs.track.sonar.config import SonarConfig, sonar_config
from servotrack.envs.track.sonar.records import draw_record
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.metrics import Track, tracks_from_rows
from servotrack.estimators.types import Array

ROW, CELL, LATE = "HMM, row", "HMM, cell (paper)", "HMM, row, 5 s late"
VITERBI, NEAREST, HUNGARIAN = "Viterbi", "peaks, nearest neighbor", "peaks, Kalman + Hungarian"
METHODS: dict[str, str] = {
    ROW: "hmm-row",
    LATE: "hmm-row",
    CELL: "hmm-cell",
    VITERBI: "viterbi",
    NEAREST: "peak-nearest-neighbor",
    HUNGARIAN: "peak-kalman-hungarian",
}
"""Compared methods: name to tracker of `servotrack.baselines.agents.sonar.catalog`. `LATE` runs row by row."""
LAG = 5
"""Delay of `LATE`, records of 1 s."""
SLOW, SLOW_STRIDE = (LATE, CELL), 5
"""Slow methods, which run on every fifth record: they repeat work for every row or every false track."""
OFFSETS = (0, -4, -8, -12, -16, -20, -22, -24)
"""Offsets from the paper's signal-to-noise ratios, dB."""
SIMULATIONS = ("rates", "cross30")
TRIAL, NOISE = "trial", "noise"
NOISE_LENGTH, NOISE_RUNS = 600, 6
"""Length of a run of noise, records of 1 s, and number of runs: one hour in total."""


class Condition(NamedTuple):
    """World and number of its records.

    Attributes:
        name: Name in tables and files.
        config: Parameters of the world, beamformed from snapshots.
        runs: Number of records, one per seed.
    """

    name: str
    config: SonarConfig
    runs: int


class Measures(NamedTuple):
    """Measurements of one method in one condition, one row per run, n columns of targets.

    Attributes:
        squared_error, tracked, present, start, end: Scores per target as in `RecordScores`, shape (runs, n).
        crossings, kept, swapped, false_tracks, count_right: Scores per run as in `RecordScores`, shape (runs,).
        seconds: Duration of tracking a record, shape (runs,), s.
    """

    squared_error: Array
    tracked: Array
    present: Array
    start: Array
    end: Array
    crossings: Array
    kept: Array
    swapped: Array
    false_tracks: Array
    count_right: Array
    seconds: Array


def simulation(variant: str, offset: int) -> str:
    """Return the name of a simulation at an offset in dB."""
    return f"{variant}{offset:+d}dB" if offset else f"{variant}-0dB"


def plan(runs: int) -> list[Condition]:
    """Return all conditions.

    Args:
        runs: Records of each condition except noise.
    """
    simulations = [
        Condition(
            simulation(variant, offset),
            sonar_config(variant=variant, snr_offset=float(offset), fidelity="snapshots", lag=LAG),
            runs,
        )
        for variant in SIMULATIONS
        for offset in OFFSETS
    ]
    return [
        *simulations,
        Condition(TRIAL, sonar_config(variant="trial", fidelity="snapshots", lag=LAG), runs),
        Condition(
            NOISE,
            sonar_config(variant="random", targets=0, horizon=NOISE_LENGTH, fidelity="snapshots", lag=LAG),
            NOISE_RUNS,
        ),
    ]


def draw_rows(config: SonarConfig, scene: SonarScene, seed: int) -> Array:
    """Return a record and the `lag` rows after it, shape (horizon + lag, beams)."""
    return np.array([draw_record(config, scene, seed, k) for k in range(config.horizon + config.lag)])


def follow(tracker: BearingTracker, scene: SonarModel, rows: Array, late: bool = False) -> list[Track]:
    """Return the tracks of a record.

    Args:
        tracker: Tracker from `sonar_tracker`.
        scene: Parameters of the receiver that agents receive.
        rows: Rows from `draw_rows`.
        late: If true, pass row by row, including the `lag` rows after the record; if false, pass the record at once.
    """
    if late:
        return _follow_late(tracker, scene, rows)
    return [
        Track(np.arange(found.first, found.last + 1), np.asarray(found.bearings)[:, None])
        for found in tracker.track(rows[: len(rows) - scene.lag])
    ]


def _follow_late(tracker: BearingTracker, scene: SonarModel, rows: Array) -> list[Track]:
    state = tracker.initial(rows[0])
    estimates = []
    for row in rows:
        state, estimate = tracker.step(state, row)
        estimates.append(estimate)
    estimates = estimates[scene.lag :]
    most = max((len(estimate.labels) for estimate in estimates), default=0)
    labels, bearings = np.full((len(estimates), most), -1), np.zeros((len(estimates), most, 1))
    for k, estimate in enumerate(estimates):
        labels[k, : len(estimate.labels)] = estimate.labels
        bearings[k, : len(estimate.labels), 0] = estimate.states[:, 0]
    return tracks_from_rows(labels, bearings)


def run_all(
    conditions: Sequence[Condition], folder: Path, progress: Progress, jobs: int = -1
) -> dict[str, dict[str, Measures]]:
    """Run all methods in all conditions. Results that `folder` already contains are read.

    Args:
        conditions: Conditions from `plan`.
        folder: Folder with one file per condition.
        progress: Progress display that gets a bar.
        jobs: Processes; -1 for all processors.

    Returns:
        Measurements by condition and method.

    Raises:
        ResultsError: A file has another setting or version, or the folder cannot be written.
    """
    paths = [folder / f"{condition.name}.npz" for condition in conditions]
    todo = [(c, path) for c, path in zip(conditions, paths, strict=True) if not path.exists()]
    bar = progress.add_task("records", total=len(conditions), completed=len(conditions) - len(todo))
    # The longest first, so that no long one runs alone at the end.
    todo.sort(key=lambda entry: -entry[0].runs * entry[0].config.horizon)
    for _ in compute_parts([PartTask(path, _setting(c), _run, (c,)) for c, path in todo], jobs):
        progress.advance(bar)
    return {c.name: _read(path, c) for c, path in zip(conditions, paths, strict=True)}


def measure(condition: Condition) -> dict[str, Measures]:
    """Return the measurements of all methods on all records of a condition."""
    config = condition.config
    scene_model = scene_model_of(config)
    trackers = {name: sonar_tracker(tracker, scene_model) for name, tracker in METHODS.items()}
    found: dict[str, list[tuple[RecordScores, float]]] = {name: [] for name in METHODS}
    for number, seed in enumerate(seeds.take("test", condition.runs)):
        scene = draw_scene(config, seed)
        rows = draw_rows(config, scene, seed)
        for name in METHODS:
            if name in SLOW and number % SLOW_STRIDE:
                continue
            if number == 0:
                # The first run compiles and fills tables, so it is not timed.
                follow(trackers[name], scene_model, rows[:20], name == LATE)
            begin = time.thread_time()
            tracks = follow(trackers[name], scene_model, rows, name == LATE)
            seconds = time.thread_time() - begin
            scores = score_tracks(scene.bearings[: config.horizon], scene.exists[: config.horizon], tracks)
            found[name].append((scores, seconds))
    return {name: _measures(runs) for name, runs in found.items()}


def _measures(runs: Sequence[tuple[RecordScores, float]]) -> Measures:
    columns = {
        name: np.array([getattr(scores, name) for scores, _ in runs], np.float64) for name in RecordScores._fields
    }
    return Measures(**columns, seconds=np.array([seconds for _, seconds in runs]))


def _run(condition: Condition) -> Arrays:
    return {
        f"{name}/{field}": values
        for name, measures in measure(condition).items()
        for field, values in measures._asdict().items()
    }


def _read(path: Path, condition: Condition) -> dict[str, Measures]:
    stored = read_part(path, _setting(condition))
    return {name: Measures(*(stored[f"{name}/{field}"] for field in Measures._fields)) for name in METHODS}


def _setting(condition: Condition) -> str:
    """Settings that a condition's results depend on, in one line."""
    return setting_of(world=asdict(condition.config), runs=condition.runs, methods=METHODS)


def growth_of_cost(
    method: str, seeds: Sequence[int], numbers: Sequence[int] = (1, 2, 3, 4, 5, 6), repetitions: int = 2
) -> dict[int, Array]:
    """Return the processor times of tracking a record of 60 s by number of targets, s.

    Each is the smallest over the repetitions, one per record. Shape (records,).

    Args:
        method: Name in `METHODS`.
        seeds: Seeds of the records, the same for every number of targets.
        numbers: Numbers of targets.
        repetitions: Passes over each record.
    """
    found = {}
    for number in numbers:
        config = sonar_config(
            variant="random", targets=number, horizon=60, shortest_life=50, rate_noise=0.0, max_rate=0.5, lag=LAG
        )
        scene_model = scene_model_of(config)
        tracker = sonar_tracker(METHODS[method], scene_model)
        least = []
        for seed in seeds:
            rows = draw_rows(config, draw_scene(config, seed), seed)
            follow(tracker, scene_model, rows[:20])
            times = []
            for _ in range(repetitions):
                begin = time.thread_time()
                follow(tracker, scene_model, rows)
                times.append(time.thread_time() - begin)
            least.append(min(times))
        found[number] = np.array(least)
    return found
