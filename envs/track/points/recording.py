"""Recorded points as the scans of an episode, with the truth where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from servotrack.envs.arguments import check_fields
from servotrack.envs.track.clutter.config import ClutterConfig
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.files.points import (
    PointScans,
    PointTruth,
    is_points_file,
    read_point_truth,
    read_points,
)
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.envs.track.points.point_extent import region_of, scores_cutoff
from servotrack.estimators.metrics import point_distances
from servotrack.estimators.types import Array, Labels, Mask

_SPARE_ROWS = 16
_MAX_ROWS = 50_000_000
"""Largest number of rows of all scans together, about 1 GB: scans times points of the fullest scan."""
_DRAWN = ClutterConfig(
    scenario="random",
    structure="HMM",
    horizon=79,
    half_width=1000.0,
    detection_probability=0.9,
    clutter_rate=10.0,
    max_targets=12,
    births="anywhere",
)
"""Scene of the points that are drawn where no source is given."""
_DRAWN_SEED = 3
"""Seed of a scene that is never empty."""
_LEFT_OUT = 4
"""Every fourth drawn scan is left out, so that intervals vary."""


@dataclass(frozen=True)
class PointsConfig:
    """Parameters of an environment of recorded points.

    Attributes:
        source: File of points, .csv or .csv.gz; see `servotrack.envs.track.files.points.read_points`. None: 60 scans
            that the clutter environment draws.
        truth: File of the true tracks, such a file with identities; the source itself if its identities are those of
            targets. None: no truth and no scores.
        start: First scan, counted from 0.
        horizon: Maximum number of scored scans; None: all that can be answered.
        lag: Delay of answers, scans: the answer to scan k is for scan k - lag. Larger values give smoothers more scans
            to work with. An episode has `horizon` + `lag` answers.
        max_estimates: Rows of an action; None: twice the points of the fullest scan and 16.
        cutoff: Cut-off c of the reward and of all scores, m; None: a fortieth of the region's longest side.

    Raises:
        ValueError: If a field is out of its range.
    """

    source: str | None = None
    truth: str | None = None
    start: int = 0
    horizon: int | None = None
    lag: int = 0
    max_estimates: int | None = None
    cutoff: float | None = None

    def __post_init__(self) -> None:
        """Check every field."""
        check_fields(self, _BOUNDS, _WHOLE, _OPTIONAL)
        for name in ("source", "truth"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, str) and is_points_file(value)):
                raise ValueError(f"{name} must be a file of points, .csv or .csv.gz, got {value!r}")
        if self.source is None and self.truth is not None:
            raise ValueError(f"truth needs a source, got {self.truth!r} without one")


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("start", 0, 1e9),
    ("horizon", 1, 1_000_000),
    ("lag", 0, 1000),
    ("max_estimates", 1, 10_000),
    ("cutoff", 1e-9, 1e9),
)
_WHOLE = ("start", "horizon", "lag", "max_estimates")
_OPTIONAL = ("horizon", "max_estimates", "cutoff")


class Bounds(NamedTuple):
    """Corners of a box. Shapes (d,), m."""

    low: Array
    high: Array


@dataclass(frozen=True)
class PointRecording:
    """Sequence of K scans of at most M points in d dimensions, with n true targets.

    Attributes:
        name: Name for titles.
        whole: All scans of the source. Bounds, default cut-off and scene model follow from them, so that they do not
            depend on the part that is played.
        points: The K scans.
        truth: True tracks; None without truth.
        horizon: Number of scored scans.
        lag: Delay of the answers, scans.
        estimate_rows: Rows of an answer.
        cutoff: Cut-off c of the scores, m.
    """

    name: str
    whole: PointScans
    points: PointScans
    truth: PointTruth | None
    horizon: int
    lag: int
    estimate_rows: int
    cutoff: float

    @cached_property
    def region(self) -> Bounds:
        """Corners of the region of points and targets."""
        low, high = region_of(self.whole)
        if self.truth is not None and len(self.truth.tracks):
            low = np.minimum(low, np.nanmin(self.truth.tracks, axis=(0, 1)))
            high = np.maximum(high, np.nanmax(self.truth.tracks, axis=(0, 1)))
        return Bounds(low, high)

    @cached_property
    def measurements(self) -> Array:
        """Sets of points with existence in column 0, shape (K, M, 1 + d)."""
        size = [len(scan) for scan in self.points.scans]
        sets = np.zeros((len(size), max(*size, 1), 1 + self.points.dimensions))
        for one, scan in zip(sets, self.points.scans, strict=True):
            one[: len(scan), 0], one[: len(scan), 1:] = 1.0, scan
        return sets

    @cached_property
    def noises(self) -> Array | None:
        """Covariances of the points' noise, zeros in unused rows, shape (K, M, d, d), m^2; None without any."""
        if self.points.covariances is None:
            return None
        scans, rows, size = self.measurements.shape
        sets = np.zeros((scans, rows, size - 1, size - 1))
        for one, scan in zip(sets, self.points.covariances, strict=True):
            one[: len(scan)] = scan
        return sets

    @cached_property
    def intervals(self) -> Array:
        """Time since the scan before, s, shape (K,); before the first scan the median of the others."""
        between = np.diff(self.points.times)
        return np.concatenate([[np.median(between)], between])

    @cached_property
    def positions(self) -> Array:
        """True positions, zeros where a target does not exist, shape (K, n, d), m."""
        tracks = np.zeros((0, len(self.points.times), self.points.dimensions))
        return np.nan_to_num((tracks if self.truth is None else self.truth.tracks).swapaxes(0, 1))

    @cached_property
    def exists(self) -> Mask:
        """Targets that exist, shape (K, n)."""
        if self.truth is None:
            return np.zeros((len(self.points.times), 0), np.bool_)
        return ~np.isnan(self.truth.tracks[:, :, 0].T)

    @cached_property
    def known(self) -> Mask:
        """Scans at which the truth says which targets exist, shape (K,)."""
        return np.zeros(len(self.points.times), np.bool_) if self.truth is None else self.truth.known

    @cached_property
    def source(self) -> Labels:
        """Index of the target of each point: -1 for none, -2 for an unused row, shape (K, M).

        It follows from the identities of the points where these have any; else from the assignment of points to true
        positions of the least total distance, each within the cut-off.
        """
        found = np.where(self.measurements[..., 0] > 0.5, -1, -2)
        if self.truth is None:
            return found
        index = {name: k for k, name in enumerate(self.truth.names)}
        for k, scan in enumerate(self.points.scans):
            if self.points.identities is not None:
                found[k, : len(scan)] = [index.get(name, -1) for name in self.points.identities[k]]
                continue
            here = np.flatnonzero(self.exists[k])
            distance = point_distances(scan, self.positions[k, here])
            rows, columns = linear_sum_assignment(np.minimum(distance, self.cutoff))
            near = distance[rows, columns] < self.cutoff
            found[k, rows[near]] = here[columns[near]]
        return found


def load_points(config: PointsConfig) -> PointRecording:
    """Read the points and the truth of a configuration.

    Raises:
        SequenceError: A file cannot be used, or holds too few scans for `start` and `lag`.
    """
    whole_truth: PointTruth | None
    if config.source is None:
        name, (whole, whole_truth) = "drawn", _drawn()
    else:
        name = Path(config.source).name
        whole = read_points(Path(config.source))
        whole_truth = None if config.truth is None else read_point_truth(Path(config.truth), whole)
    total = len(whole.times)
    if total - config.start < max(2, config.lag + 1):
        raise SequenceError(
            f"start must leave at least {max(2, config.lag + 1)} of the {total} scans of {name} with lag="
            f"{config.lag}, got {config.start}"
        )
    horizon = min(config.horizon or total, total - config.start - config.lag)
    end = min(config.start + horizon + config.lag + 1, total)
    points, truth = _between(whole, whole_truth, config.start, end)
    if truth is not None and not truth.known[:horizon].any():
        raise SequenceError(
            f"{config.truth} must overlap scans {config.start} to {end - 1} of {name} in time; choose another start or "
            "horizon"
        )
    most = max(len(scan) for scan in points.scans)
    if most == 0:
        raise SequenceError(f"{name} has no points in its scans {config.start} to {end - 1}; choose another start")
    if most * len(points.times) > _MAX_ROWS:
        raise SequenceError(
            f"{name}: {len(points.times)} scans of up to {most} points need {most * len(points.times)} rows, the limit "
            f"is {_MAX_ROWS}; set a smaller horizon"
        )
    return PointRecording(
        name=name,
        whole=whole,
        points=points,
        truth=truth,
        horizon=horizon,
        lag=config.lag,
        estimate_rows=config.max_estimates or 2 * most + _SPARE_ROWS,
        cutoff=config.cutoff or scores_cutoff(*region_of(whole)),
    )


def _between(
    points: PointScans, truth: PointTruth | None, start: int, end: int
) -> tuple[PointScans, PointTruth | None]:
    """Return scans `start` to `end` - 1, and the targets that exist in any of them."""
    kept = slice(start, end)
    some = points._replace(
        times=points.times[kept],
        scans=points.scans[kept],
        covariances=None if points.covariances is None else points.covariances[kept],
        identities=None if points.identities is None else points.identities[kept],
    )
    if truth is None:
        return some, None
    tracks = truth.tracks[:, kept]
    there = np.flatnonzero(~np.isnan(tracks[:, :, 0]).all(axis=1))
    return some, PointTruth([truth.names[k] for k in there.tolist()], tracks[there], truth.known[kept])


@lru_cache(maxsize=1)
def _drawn() -> tuple[PointScans, PointTruth]:
    """Return points of a drawn scene, the same for every seed, and their truth."""
    episode = draw_episode(_DRAWN, _DRAWN_SEED)
    kept = [k for k in range(_DRAWN.horizon + 1) if k % _LEFT_OUT != _LEFT_OUT - 1]
    used = [episode.source[k] > -2 for k in kept]
    exists = episode.exists[kept]
    there = exists.any(axis=0)
    tracks = np.where(exists[..., None], episode.states[kept][..., [0, 2]], np.nan).swapaxes(0, 1)[there]
    names = [str(k) for k in np.flatnonzero(there)]
    points = PointScans(
        times=np.array(kept, dtype=np.float64) * _DRAWN.period,
        scans=[episode.measurements[k][rows, 1:] for k, rows in zip(kept, used, strict=True)],
        covariances=None,
        identities=[
            [str(one) if one >= 0 else "" for one in episode.source[k][rows].tolist()]
            for k, rows in zip(kept, used, strict=True)
        ],
        origin=None,
        dated=False,
    )
    return points, PointTruth(names, tracks, np.ones(len(kept), np.bool_))
