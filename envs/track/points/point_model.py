"""The filter of recorded points: its parameters, the units in which it computes, and its tracks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.points import PointScans
from servotrack.envs.track.points.clutter_map import ClutterMap, MappedClutter
from servotrack.envs.track.points.point_extent import bounds_of, period_of, side_of
from servotrack.estimators.rfs import (
    Birth,
    HiddenMarkovModel,
    Reduction,
    Trajectory,
    TrajectoryPMB,
    constant_velocity,
    track_scans,
)
from servotrack.estimators.types import Array

_LAGS = (10, 30)
"""Shortest and longest smoothing lag, scans."""
_LAG_DETECTIONS = 5.0
"""Detections of a target that the lag should hold."""
LEAST_EXISTENCE = 1e-5
"""Tracks of less probability are dropped. A first detection in much clutter is less than 0.001 probable."""
_LARGEST_NOISE = 1e4
"""Largest standard deviation of a measurement as a share of the region's side: it says nothing either way."""
LEAST_NOISE = 1e-7
"""Least standard deviation of a measurement as a share of the region's side: below it rounding decides."""


class PointModel(NamedTuple):
    """Parameters of a filter of points; everything per scan is per `period`.

    Attributes:
        period: Usual interval between scans, s: nine of ten are at most as long.
        low, high: Corners of the region. Shape (d,), m.
        process_noise: Square root of the spectral density of the acceleration, m/s^1.5.
        measurement_noise: Standard deviation of a coordinate, m; None if the file has covariances.
        detection: Probability that a scan contains a measurement of a target.
        clutter_rate: Mean number of measurements of no target in a scan.
        births: Mean number of new targets per scan.
        survival: Probability that a target survives one scan.
        speed: Root mean square of a coordinate of the velocity, m/s.
        maneuver: Probability of a maneuver in one period; 0 if the points show none.
        agility: Factor on the process noise in a maneuver.
        clutter_map: Density of clutter over the region; None if it is uniform.
    """

    period: float
    low: Array
    high: Array
    process_noise: float
    measurement_noise: float | None
    detection: float
    clutter_rate: float
    births: float
    survival: float
    speed: float
    maneuver: float = 0.0
    agility: float = 1.0
    clutter_map: ClutterMap | None = None


class Units(NamedTuple):
    """Units in which the points are tracked, powers of two: an interval is 1 to 2, the region's side 1,024 to 2,048.

    Attributes:
        time: s.
        length: m.
        origin: Middle of the bounds of all points. Shape (d,), m.
    """

    time: float
    length: float
    origin: Array

    @classmethod
    def of(cls, points: PointScans) -> Units:
        """Units of a file of points."""
        time, length = (2.0 ** math.floor(math.log2(one)) for one in (period_of(points), side_of(points) / 1024.0))
        low, high = bounds_of(points)
        return cls(time, length, low + 0.5 * (high - low))

    def points(self, points: PointScans) -> PointScans:
        """Points in these units."""
        covariances = points.covariances
        return points._replace(
            times=points.times / self.time,
            scans=[(scan - self.origin) / self.length for scan in points.scans],
            covariances=None if covariances is None else [one / self.length / self.length for one in covariances],
        )

    def model(self, model: PointModel, *, back: bool = False) -> PointModel:
        """Model in these units, or from them back in s and m."""
        time, length = (1.0 / self.time, 1.0 / self.length) if back else (self.time, self.length)
        noise, density = model.measurement_noise, model.clutter_map
        shift = self.origin if back else -self.origin / self.length
        return model._replace(
            period=model.period / time,
            low=model.low / length + shift,
            high=model.high / length + shift,
            process_noise=model.process_noise / length * time**1.5,
            measurement_noise=None if noise is None else noise / length,
            speed=model.speed / length * time,
            clutter_map=density
            and density._replace(low=density.low / length + shift, high=density.high / length + shift),
        )

    def back(self, trajectory: Trajectory) -> Trajectory:
        """Trajectory in s and m."""
        scale = np.tile([self.length, self.length / self.time], trajectory.states.shape[1] // 2)
        return Trajectory(
            trajectory.label,
            trajectory.times * self.time,
            trajectory.states * scale + np.stack([self.origin, np.zeros_like(self.origin)], axis=1).reshape(-1),
            trajectory.covariances * scale[:, None] * scale,
            trajectory.existence,
        )


def track_points(points: PointScans, model: PointModel) -> list[Trajectory]:
    """Track points with the parameters of a model; smoothed over `smoothing_lag` scans."""
    units = Units.of(points)
    return [units.back(one) for one in tracked(units.points(points), units.model(model))]


def tracked(points: PointScans, model: PointModel) -> list[Trajectory]:
    """Track points as `track_points` does, in the units that they have."""
    tracker = _tracker(points, model)
    return track_scans(tracker, points.scans, points.times, noises=_noises(points, position_noise(points, model)))


def _tracker(points: PointScans, model: PointModel) -> TrajectoryPMB:
    center, covariance = birth_place(model)
    return TrajectoryPMB(
        motion_of(points, model),
        Birth(np.array([min(model.births, 1.0)]), center[None], covariance),
        clutter_intensity=clutter_intensity(model),
        survival=model.survival,
        detection=model.detection,
        reduction=Reduction(components=5, existence=LEAST_EXISTENCE),
        lag=smoothing_lag(points, model),
        maneuver=model.maneuver,
        agility=model.agility,
    )


def clutter_intensity(model: PointModel) -> float | MappedClutter:
    """Expected number of false measurements in a scan per unit of measurement space; a function where it varies."""
    uniform = model.clutter_rate / float(np.prod(model.high - model.low))
    return uniform if model.clutter_map is None else MappedClutter(uniform, model.clutter_map)


def motion_of(points: PointScans, model: PointModel) -> HiddenMarkovModel:
    """Motion and measurement of one target with measured parameters."""
    noise = position_noise(points, model)
    return constant_velocity(model.process_noise, noise, period=model.period, dimensions=points.dimensions)


def birth_place(model: PointModel) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the states of new targets: one Gaussian as wide as the region.

    Births at measurements would also take place where targets already are.
    """
    deviation = np.stack([(model.high - model.low) / math.sqrt(12.0), np.full(len(model.low), model.speed)], axis=1)
    center = np.stack([0.5 * (model.low + model.high), np.zeros(len(model.low))], axis=1)
    return center.reshape(-1), np.diag(deviation.reshape(-1) ** 2)


def smoothing_lag(points: PointScans, model: PointModel) -> int:
    """Smoothing lag of the tracker, scans; longer where targets are detected rarely."""
    return min(int(np.clip(math.ceil(_LAG_DETECTIONS / model.detection), *_LAGS)), len(points.times) - 1)


def position_noise(points: PointScans, model: PointModel) -> float:
    """Standard deviation of a usual measurement's coordinate, m."""
    if model.measurement_noise is not None:
        return model.measurement_noise
    usual = float(np.sqrt(np.mean([np.trace(R) / len(R) for scan in points.covariances or [] for R in scan])))
    return min(usual, _LARGEST_NOISE * side_of(points))


def _noises(points: PointScans, usual: float) -> list[Array] | None:
    """Covariance of each measurement's noise, none so small that rounding would decide.

    Args:
        points: The points.
        usual: Standard deviation of a usual measurement, m.
    """
    if points.covariances is None:
        return None
    found = []
    for scan in points.covariances:
        # Beyond many times the region a covariance says nothing, however large.
        total = np.maximum(np.trace(scan, axis1=1, axis2=2), 1e-300)
        scan = scan * np.minimum(1.0, (_LARGEST_NOISE * side_of(points)) ** 2 / total)[:, None, None]
        largest = np.abs(scan).max(axis=(1, 2), initial=0.0)
        least = np.maximum((LEAST_NOISE * side_of(points)) ** 2, 1e-8 * np.maximum(largest, usual**2))
        values = np.linalg.eigvalsh(scan)[:, 0] if len(scan) else largest
        found.append(scan + np.maximum(least - values, 0.0)[:, None, None] * np.eye(points.dimensions))
    return found
