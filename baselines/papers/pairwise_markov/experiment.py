"""Paper 004's experiment: set filters under hidden and pairwise Markov models on the same scans of twelve targets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.clutter.catalog import FilterSettings, track_filter
from servotrack.envs.streams import episode_seed
from servotrack.envs.track.clutter.config import ClutterConfig, clutter_config
from servotrack.envs.track.clutter.episode import ClutterEpisode, draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.metrics import ospa2, score_points, stack_tracks, tracks_from_rows, trajectory_gospa
from servotrack.estimators.stateful import Stateful
from servotrack.estimators.types import Array, Labels, Mask

CUTOFF = 100.0
"""The c of OSPA and GOSPA, m."""
NARROW_CUTOFF = 20.0
"""A second c under which the error of located targets shows, m."""
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
"""Name of a method, the filter behind it, and its settings."""
PAPER_METHODS = ("PHD-HMM", "PHD-PMM", "CBMeMBer-HMM", "CBMeMBer-PMM")
OUR_METHODS = ("PMB-HMM", "PMB-PMM")
EXTRACTION_METHODS = ("PHD-HMM sum", "PHD-PMM sum", "CBMeMBer-HMM map", "CBMeMBer-PMM map")


@dataclass(frozen=True)
class Condition:
    """One cell of the experiment.

    Attributes:
        name: Unique; a folder's name.
        methods: Names in `METHODS`; all see the same scans.
        world: Keywords of `clutter_config` at level 0.
        trajectories: Whether trajectory GOSPA, which takes longer than filtering, is computed.
    """

    name: str
    methods: tuple[str, ...]
    world: dict[str, Any] = field(default_factory=dict)
    trajectories: bool = False

    @property
    def config(self) -> ClutterConfig:
        """The world."""
        return clutter_config(0, **self.world)


class Measures(NamedTuple):
    """What one method did in R runs of T scans.

    Attributes:
        ospa: c = 100 m, p = 1, positions. Shape (R, T), m.
        ospa_squared: The same with p = 2.
        ospa_narrow: c = 20 m, p = 1.
        gospa: c = 100 m, p = 2.
        number: Extracted targets. Shape (R, T).
        expected: The filter's own expected number. Shape (R, T).
        ospa2: Of the trajectories. Shape (R,), m.
        trajectory_gospa: Shape (R,), m; NaN where it was not asked for.
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
    """The episodes that `ClutterTracking-v0` deals after `reset(seed=...)`, one per seed."""
    return [draw_episode(config, episode_seed(np.random.Generator(np.random.PCG64(seed)))) for seed in seeds]


def run_condition(condition: Condition, seeds: Sequence[int]) -> dict[str, Measures]:
    """All methods of a condition on the same runs, as one batch.

    Args:
        condition: World and methods.
        seeds: Of the runs.

    Returns:
        Measures of each method, in the order of the seeds.
    """
    config = condition.config
    episodes = draw_runs(config, seeds)
    scans = np.stack([episode.measurements[:-1] for episode in episodes], axis=1)
    truth = np.stack([episode.states[:-1][:, :, list(POSITION)] for episode in episodes], axis=1)
    exists = np.stack([episode.exists[:-1] for episode in episodes], axis=1)
    return {name: _run_method(name, condition, scans, truth, exists) for name in condition.methods}


def _run_method(name: str, condition: Condition, scans: Array, truth: Array, exists: Mask) -> Measures:
    filter_name, settings = METHODS[name]
    tracker = Stateful(track_filter(filter_name, scene_model_of(condition.config), settings))
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
    """One run's reported identities as tracks, shape (k, T, 2)."""
    most = max(len(row) for row in labels)
    names, places = np.full((len(labels), most), -1, dtype=np.int64), np.zeros((len(labels), most, 2))
    for step, (label, position) in enumerate(zip(labels, positions, strict=True)):
        names[step, : len(label)], places[step, : len(label)] = label, position
    return stack_tracks(tracks_from_rows(names, places), len(labels), 2)


def time_steps(names: Sequence[str], condition: Condition, seeds: Sequence[int]) -> dict[str, Array]:
    """Median durations of a single step: filtering alone, compiled, unbatched, all methods in turn on each run.

    Args:
        names: Methods.
        condition: The world.
        seeds: Of the runs; the first run only compiles, or loads what was compiled.

    Returns:
        One median for each run after the first, shape (len(seeds) - 1,), s.
    """
    found: dict[str, list[float]] = {name: [] for name in names}
    scene = scene_model_of(condition.config)
    for episode in draw_runs(condition.config, seeds):
        scans = [scan[scan[:, 0] > 0.5, 1:] for scan in episode.measurements[:-1]]
        for name in names:
            filter_name, settings = METHODS[name]
            tracker = Stateful(track_filter(filter_name, scene, settings))
            durations = []
            for z in scans:
                begin = time.perf_counter()
                tracker.step(z)
                durations.append(time.perf_counter() - begin)
            found[name].append(float(np.median(durations)))
    return {name: np.array(medians[1:]) for name, medians in found.items()}


class SingleRun(NamedTuple):
    """One run in full, for figures 1 and 2.

    Attributes:
        truth: Shape (n, T, 2), m; NaN where a target does not exist.
        estimates: Extracted positions at each scan, (k, 2) each, m.
        clutter: Every measurement, with its scan: shape (z, 3) as scan, x, y.
    """

    truth: Array
    estimates: list[Array]
    clutter: Array


def single_run(name: str, condition: Condition, seed: int) -> SingleRun:
    """One run of one method."""
    (episode,) = draw_runs(condition.config, [seed])
    filter_name, settings = METHODS[name]
    tracker = Stateful(track_filter(filter_name, scene_model_of(condition.config), settings))
    estimates, measurements = [], []
    for step, scan in enumerate(episode.measurements[:-1]):
        z = scan[scan[:, 0] > 0.5, 1:]
        estimates.append(tracker.step(z).states[:, list(POSITION)])
        measurements.append(np.column_stack([np.full(len(z), step + 1.0), z]))
    positions = episode.states[:-1][:, :, list(POSITION)]
    truth = np.where(episode.exists[:-1, :, None], positions, np.nan).swapaxes(0, 1)
    return SingleRun(truth, estimates, np.concatenate(measurements))
