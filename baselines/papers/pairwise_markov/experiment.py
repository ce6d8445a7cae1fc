"""Experiment of Zhang et al. (2017): set filters under hidden and pairwise Markov models on scans of twelve targets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.baselines.agents.clutter.catalog import FilterSettings, track_filter
from servotrack.envs.streams import episode_seed
from servotrack.envs.track.clutter.config import ClutterConfig, clutter_config
from servotrack.envs.track.clutter.episode import ClutterEpisode, draw_episode
from servotrack.envs.track.clutter.scene_model import SceneModel, scene_model_of
from servotrack.estimators.metrics import ospa2, score_points, stack_tracks, tracks_from_rows, trajectory_gospa
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.stateful import Stateful
from servotrack.estimators.types import Array, Estimator, Labels, Mask

CUTOFF = 100.0
"""The c of OSPA and GOSPA, m."""
NARROW_CUTOFF = 20.0
"""Smaller c that weights the error of located targets more, m."""
SWITCH_COST = 20.0
"""The gamma of trajectory GOSPA, m."""
POSITION = (0, 2)

METHODS: dict[str, tuple[str, FilterSettings]] = {
    "PHD-HMM": ("gm-phd", FilterSettings(hidden_markov=True)),
    "PHD-PMM": ("gm-phd", FilterSettings()),
    "CBMeMBer-HMM": ("gm-cbmember", FilterSettings(hidden_markov=True)),
    "CBMeMBer-PMM": ("gm-cbmember", FilterSettings()),
    "PMB-HMM": ("pmb", FilterSettings(hidden_markov=True)),
    "PMB-PMM": ("pmb", FilterSettings()),
    "PHD-HMM sum": ("gm-phd", FilterSettings(hidden_markov=True, extraction="sum")),
    "PHD-PMM sum": ("gm-phd", FilterSettings(extraction="sum")),
    "CBMeMBer-HMM map": ("gm-cbmember", FilterSettings(hidden_markov=True, extraction="map")),
    "CBMeMBer-PMM map": ("gm-cbmember", FilterSettings(extraction="map")),
    "GNN-PMM": ("gnn", FilterSettings()),
    "SMC-PHD": ("smc-phd", FilterSettings(hidden_markov=True)),
}
"""Compared methods: name to filter and its settings."""
PAPER_METHODS = ("PHD-HMM", "PHD-PMM", "CBMeMBer-HMM", "CBMeMBer-PMM")
OUR_METHODS = ("PMB-HMM", "PMB-PMM")
EXTRACTION_METHODS = ("PHD-HMM sum", "PHD-PMM sum", "CBMeMBer-HMM map", "CBMeMBer-PMM map")


@dataclass(frozen=True)
class Condition:
    """One condition of the experiment.

    Attributes:
        name: Unique name, also of the folder.
        methods: Names in `METHODS`. All filter the same scans.
        world: Keywords of `clutter_config` at level 0.
        trajectories: If true, also compute trajectory GOSPA, which takes longer than filtering.
    """

    name: str
    methods: tuple[str, ...]
    world: dict[str, Any] = field(default_factory=dict)
    trajectories: bool = False

    @property
    def config(self) -> ClutterConfig:
        """Parameters of the world."""
        return clutter_config(0, **self.world)


class Measures(NamedTuple):
    """Measurements of one method in R runs of T scans.

    Attributes:
        ospa: OSPA of positions with c = 100 m and p = 1, shape (R, T), m.
        ospa_squared: OSPA with p = 2, shape (R, T), m.
        ospa_narrow: OSPA with c = 20 m and p = 1, shape (R, T), m.
        gospa: GOSPA with c = 100 m and p = 2, shape (R, T), m.
        number: Number of extracted targets, shape (R, T).
        expected: Expected number of targets of the filter itself, shape (R, T).
        ospa2: OSPA(2) of the trajectories, shape (R,), m.
        trajectory_gospa: Trajectory GOSPA, shape (R,), m; NaN if not computed.
    """

    ospa: Array
    ospa_squared: Array
    ospa_narrow: Array
    gospa: Array
    number: Array
    expected: Array
    ospa2: Array
    trajectory_gospa: Array


def draw_runs(config: ClutterConfig, seeds: Sequence[int]) -> list[ClutterEpisode]:
    """Return the episodes that `ClutterTracking-v0` draws after `reset(seed=...)`, one per seed."""
    return [draw_episode(config, episode_seed(np.random.Generator(np.random.PCG64(seed)))) for seed in seeds]


def run_condition(condition: Condition, seeds: Sequence[int]) -> dict[str, Measures]:
    """Run all methods of a condition on the same scans, as one batch.

    Args:
        condition: World and methods.
        seeds: Seeds of the runs.

    Returns:
        Measurements of each method, in the order of the seeds.
    """
    config = condition.config
    episodes = draw_runs(config, seeds)
    scans = np.stack([episode.measurements[:-1] for episode in episodes], axis=1)
    truth = np.stack([episode.states[:-1][:, :, list(POSITION)] for episode in episodes], axis=1)
    exists = np.stack([episode.exists[:-1] for episode in episodes], axis=1)
    return {name: _run_method(name, condition, scans, truth, exists) for name in condition.methods}


def _stateful_filter(name: str, scene: SceneModel) -> Stateful[ArrayLike, Any, SetEstimate]:
    filter_name, settings = METHODS[name]
    estimator: Estimator[ArrayLike, Any, SetEstimate] = track_filter(filter_name, scene, settings)
    return Stateful(estimator)


def _run_method(name: str, condition: Condition, scans: Array, truth: Array, exists: Mask) -> Measures:
    tracker = _stateful_filter(name, scene_model_of(condition.config))
    steps, runs = scans.shape[:2]
    columns = {key: np.zeros((runs, steps)) for key in Measures._fields[:6]}
    labels: list[Labels] = []
    positions: list[Array] = []
    for step in range(steps):
        estimate = tracker.step(scans[step])
        reported = estimate.labels > 0
        where = estimate.states[..., list(POSITION)]
        labels.append(np.where(reported, estimate.labels, -1))
        positions.append(where)
        masks = exists[step], reported
        first = score_points(truth[step], where, CUTOFF, 1.0, *masks)
        squared = score_points(truth[step], where, CUTOFF, 2.0, *masks)
        columns["ospa"][:, step] = first.ospa
        columns["ospa_squared"][:, step] = squared.ospa
        columns["ospa_narrow"][:, step] = score_points(truth[step], where, NARROW_CUTOFF, 1.0, *masks).ospa
        columns["gospa"][:, step] = squared.gospa.total
        columns["number"][:, step] = reported.sum(axis=1)
        columns["expected"][:, step] = estimate.expected_number
    whole, switched = np.zeros(runs), np.full(runs, np.nan)
    for run in range(runs):
        tracks = _tracks([label[run] for label in labels], [position[run] for position in positions])
        true = np.where(exists[:, run, :, None], truth[:, run], np.nan).swapaxes(0, 1)
        whole[run] = ospa2(true, tracks, CUTOFF)
        if condition.trajectories:
            switched[run] = trajectory_gospa(true, tracks, CUTOFF, SWITCH_COST).total
    return Measures(**columns, ospa2=whole, trajectory_gospa=switched)


def _tracks(labels: list[Labels], positions: list[Array]) -> Array:
    """Reported tracks of one run, shape (k, T, 2)."""
    most = max(len(row) for row in labels)
    names, places = np.full((len(labels), most), -1, dtype=np.int64), np.zeros((len(labels), most, 2))
    for step, (label, position) in enumerate(zip(labels, positions, strict=True)):
        names[step, : len(label)], places[step, : len(label)] = label, position
    return stack_tracks(tracks_from_rows(names, places), len(labels), 2)


def time_steps(names: Sequence[str], condition: Condition, seeds: Sequence[int]) -> dict[str, Array]:
    """Return median durations of one unbatched step of the filters, all methods in turn on each run.

    Args:
        names: Names in `METHODS`.
        condition: Condition with the world.
        seeds: Seeds of the runs. The first run is not timed, because it compiles.

    Returns:
        Median of each run after the first, by method, shape (len(seeds) - 1,), s.
    """
    found: dict[str, list[float]] = {name: [] for name in names}
    scene = scene_model_of(condition.config)
    for episode in draw_runs(condition.config, seeds):
        scans = [scan[scan[:, 0] > 0.5, 1:] for scan in episode.measurements[:-1]]
        for name in names:
            tracker = _stateful_filter(name, scene)
            durations = []
            for z in scans:
                begin = time.perf_counter()
                tracker.step(z)
                durations.append(time.perf_counter() - begin)
            found[name].append(float(np.median(durations)))
    return {name: np.array(medians[1:]) for name, medians in found.items()}


class SingleRun(NamedTuple):
    """Positions of one run, for figures 1 and 2.

    Attributes:
        truth: True positions, shape (n, T, 2), m; NaN while a target does not exist.
        estimates: Extracted positions of each scan, (k, 2) each, m.
        clutter: All measurements with columns scan, x, y, shape (z, 3).
    """

    truth: Array
    estimates: list[Array]
    clutter: Array


def single_run(name: str, condition: Condition, seed: int) -> SingleRun:
    """Return one run of one method."""
    (episode,) = draw_runs(condition.config, [seed])
    tracker = _stateful_filter(name, scene_model_of(condition.config))
    estimates, measurements = [], []
    for step, scan in enumerate(episode.measurements[:-1]):
        z = scan[scan[:, 0] > 0.5, 1:]
        estimates.append(tracker.step(z).states[:, list(POSITION)])
        measurements.append(np.column_stack([np.full(len(z), step + 1.0), z]))
    positions = episode.states[:-1][:, :, list(POSITION)]
    truth = np.where(episode.exists[:-1, :, None], positions, np.nan).swapaxes(0, 1)
    return SingleRun(truth, estimates, np.concatenate(measurements))
