"""Ready sensors: bearing, range and bearing, azimuth, elevation and range, each with the range rate if it is measured.

All take the place and the velocity of the sensor, so one that moves is a new sensor for every scan. Angles are counted
counterclockwise from the first axis; elevation is the angle above the plane of the first two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.range_bearing import SMALLEST_RANGE
from servotrack.estimators.rfs.sensors import FunctionSensor, Intensity, Places, Probability
from servotrack.estimators.types import Array


def bearing_sensor(
    bearing_deviation: float,
    *,
    at: ArrayLike = (0.0, 0.0),
    position: Sequence[int] = (0, 2),
    distances: tuple[float, float] | None = None,
    pieces: int = 6,
    detection: Probability | None = None,
    clutter_intensity: Intensity | None = None,
) -> FunctionSensor:
    """A sensor that measures the bearing of a target in the plane, rad.

    Args:
        bearing_deviation: Standard deviation of a bearing, rad.
        at: Position of the sensor. Shape (2,), m.
        position: Indices of x and y in the state.
        distances: Least and largest distance at which a target may appear, m, for births at bearings; None: bearings
            start no tracks by themselves.
        pieces: Number of Gaussians along a bearing between these distances, each as long as its share of the ratio of
            the distances (Peach 1995). Raising it makes each short against its distance, which the filter's transform
            needs, and costs time.
        detection: Detection probability; None: the filter's.
        clutter_intensity: Expected false bearings per scan and rad; None: the filter's.

    Raises:
        ValueError: An argument is out of range or has a wrong shape.
    """
    view = _View(_axes(position, 2), _point("at", at, 2))
    noise = _noise(bearing_deviation=bearing_deviation)
    places = None
    if distances is not None:
        low, high = distances
        if not (math.isfinite(high) and 0.0 < low < high):
            raise ValueError(f"distances must be (least, largest) with 0 < least < largest, got {distances!r}")
        if pieces < 1:
            raise ValueError(f"pieces must be at least 1, got {pieces!r}")
        places = _AlongBearing(view.at, bearing_deviation, tuple(np.geomspace(low, high, pieces + 1)))
    return FunctionSensor(
        _Measured(view, None, ("bearing",)),
        noise,
        angular=(True,),
        position=view.position,
        places=places,
        detection=detection,
        clutter_intensity=clutter_intensity,
    )


def range_bearing_sensor(
    range_deviation: float,
    bearing_deviation: float,
    range_rate_deviation: float | None = None,
    *,
    at: ArrayLike = (0.0, 0.0),
    moving: ArrayLike = (0.0, 0.0),
    position: Sequence[int] = (0, 2),
    velocity: Sequence[int] = (1, 3),
    detection: Probability | None = None,
    clutter_intensity: Intensity | None = None,
) -> FunctionSensor:
    """A sensor that measures range (m), bearing (rad) and possibly range rate (m/s) of a target in the plane.

    Args:
        range_deviation: Standard deviation of a range, m.
        bearing_deviation: Standard deviation of a bearing, rad.
        range_rate_deviation: Standard deviation of a range rate (Doppler), m/s; None: not measured.
        at: Position of the sensor. Shape (2,), m.
        moving: Velocity of the sensor, which the range rate is relative to. Shape (2,), m/s.
        position: Indices of x and y in the state.
        velocity: Indices of their velocities in the state.
        detection: Detection probability; None: the filter's.
        clutter_intensity: Expected false measurements per scan and m rad (m rad m/s with a range rate); None: the
            filter's.

    Raises:
        ValueError: An argument is out of range or has a wrong shape.
    """
    measured = (("range", "range_deviation", range_deviation), ("bearing", "bearing_deviation", bearing_deviation))
    return _ranging(
        measured, range_rate_deviation, 2, at, moving, position, velocity, _FromPolar, detection, clutter_intensity
    )


def spherical_sensor(
    azimuth_deviation: float,
    elevation_deviation: float,
    range_deviation: float,
    range_rate_deviation: float | None = None,
    *,
    at: ArrayLike = (0.0, 0.0, 0.0),
    moving: ArrayLike = (0.0, 0.0, 0.0),
    position: Sequence[int] = (0, 2, 4),
    velocity: Sequence[int] = (1, 3, 5),
    detection: Probability | None = None,
    clutter_intensity: Intensity | None = None,
) -> FunctionSensor:
    """A sensor that measures azimuth and elevation (rad), range (m) and possibly range rate (m/s), such as a radar.

    Args:
        azimuth_deviation: Standard deviation of an azimuth, rad.
        elevation_deviation: Standard deviation of an elevation, rad.
        range_deviation: Standard deviation of a range, m.
        range_rate_deviation: Standard deviation of a range rate (Doppler), m/s; None: not measured.
        at: Position of the sensor. Shape (3,), m.
        moving: Velocity of the sensor, which the range rate is relative to. Shape (3,), m/s.
        position: Indices of x, y and z in the state.
        velocity: Indices of their velocities in the state.
        detection: Detection probability; None: the filter's.
        clutter_intensity: Expected false measurements per scan and rad^2 m (rad^2 m^2/s with a range rate); None: the
            filter's.

    Raises:
        ValueError: An argument is out of range or has a wrong shape.
    """
    measured = (
        ("bearing", "azimuth_deviation", azimuth_deviation),
        ("elevation", "elevation_deviation", elevation_deviation),
        ("range", "range_deviation", range_deviation),
    )
    return _ranging(
        measured, range_rate_deviation, 3, at, moving, position, velocity, _FromSpherical, detection, clutter_intensity
    )


def _ranging(
    measured: Sequence[tuple[str, str, float]],
    range_rate_deviation: float | None,
    size: int,
    at: ArrayLike,
    moving: ArrayLike,
    position: Sequence[int],
    velocity: Sequence[int],
    places: Callable[[tuple[float, ...], Array], Callable[[Array], Places]],
    detection: Probability | None,
    clutter_intensity: Intensity | None,
) -> FunctionSensor:
    """A sensor of as many entries as the position has, given by entry, argument and deviation, and the range rate."""
    view, doppler = _View(_axes(position, size), _point("at", at, size)), None
    if range_rate_deviation is not None:
        doppler = _Doppler(_axes(velocity, size), _point("moving", moving, size))
        measured = (*measured, ("range rate", "range_rate_deviation", range_rate_deviation))
    noise = _noise(**{argument: deviation for _, argument, deviation in measured})
    entries = tuple(entry for entry, _, _ in measured)
    return FunctionSensor(
        _Measured(view, doppler, entries),
        noise,
        angular=[entry in ("bearing", "elevation") for entry in entries],
        position=view.position,
        places=places(view.at, noise[:size, :size]),
        detection=detection,
        clutter_intensity=clutter_intensity,
    )


@dataclass(frozen=True)
class _View:
    """Position of a target relative to the sensor."""

    position: tuple[int, ...]
    at: tuple[float, ...]

    def __call__(self, states: Array) -> Array:
        return states[:, list(self.position)] - np.array(self.at)


@dataclass(frozen=True)
class _Doppler:
    """Velocity of a target relative to the sensor."""

    velocity: tuple[int, ...]
    moving: tuple[float, ...]

    def __call__(self, states: Array) -> Array:
        return states[:, list(self.velocity)] - np.array(self.moving)


@dataclass(frozen=True)
class _Measured:
    """The measured entries of states."""

    view: _View
    doppler: _Doppler | None
    entries: tuple[str, ...]

    def __call__(self, states: Array) -> Array:
        offset = self.view(states)
        distance = np.sqrt((offset**2).sum(axis=1))
        values = []
        for entry in self.entries:
            if entry == "range":
                values.append(distance)
            elif entry == "bearing":
                values.append(np.arctan2(offset[:, 1], offset[:, 0]))
            elif entry == "elevation":
                values.append(np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1])))
            elif self.doppler is not None:
                values.append((offset * self.doppler(states)).sum(axis=1) / np.maximum(distance, SMALLEST_RANGE))
        return np.stack(values, axis=1)


@dataclass(frozen=True, eq=False)
class _FromPolar:
    """Positions of ranges and bearings."""

    at: tuple[float, ...]
    noise: Array

    def __call__(self, z: Array) -> Places:
        distance, cosine, sine = z[:, 0], np.cos(z[:, 1]), np.sin(z[:, 1])
        mean = np.array(self.at) + distance[:, None] * np.stack([cosine, sine], axis=1)
        slope = np.stack(
            [np.stack([cosine, -distance * sine], axis=1), np.stack([sine, distance * cosine], axis=1)], axis=1
        )
        return _one_piece(mean, slope, self.noise)


@dataclass(frozen=True, eq=False)
class _FromSpherical:
    """Positions of azimuths, elevations and ranges."""

    at: tuple[float, ...]
    noise: Array

    def __call__(self, z: Array) -> Places:
        ca, sa, ce, se = np.cos(z[:, 0]), np.sin(z[:, 0]), np.cos(z[:, 1]), np.sin(z[:, 1])
        distance = z[:, 2]
        direction = np.stack([ca * ce, sa * ce, se], axis=1)
        sideways = np.stack([-sa * ce, ca * ce, np.zeros_like(se)], axis=1)
        upward = np.stack([-ca * se, -sa * se, ce], axis=1)
        slope = np.stack([distance[:, None] * sideways, distance[:, None] * upward, direction], axis=2)
        return _one_piece(np.array(self.at) + distance[:, None] * direction, slope, self.noise)


@dataclass(frozen=True)
class _AlongBearing:
    """Positions along bearings: one Gaussian between each two successive distances."""

    at: tuple[float, ...]
    deviation: float
    borders: tuple[float, ...]

    def __call__(self, z: Array) -> Places:
        borders = np.array(self.borders)
        distance, length = 0.5 * (borders[1:] + borders[:-1]), np.diff(borders) / math.sqrt(12.0)
        cosine, sine = np.cos(z[:, 0])[:, None], np.sin(z[:, 0])[:, None]
        along = np.stack([cosine, sine], axis=2)
        across = np.stack([-sine, cosine], axis=2)
        mean = np.array(self.at) + distance[:, None] * along
        width = (self.deviation * distance)[:, None, None] ** 2
        covariance = length[:, None, None] ** 2 * (along[..., :, None] * along[..., None, :]) + width * (
            across[..., :, None] * across[..., None, :]
        )
        return Places(mean, covariance)


def _one_piece(mean: Array, slope: Array, noise: Array) -> Places:
    """Gaussians by the first-order transform of the measurement noise."""
    return Places(mean[:, None], np.einsum("zij,jk,zlk->zil", slope, noise, slope)[:, None])


def _axes(indices: Sequence[int], number: int) -> tuple[int, ...]:
    chosen = tuple(int(entry) for entry in indices)
    if len(chosen) != number:
        raise ValueError(f"position and velocity must be {number} indices of the state, got {tuple(indices)!r}")
    return chosen


def _point(name: str, value: ArrayLike, size: int) -> tuple[float, ...]:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (size,) or not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be {size} finite coordinates, got {value!r}")
    return tuple(float(entry) for entry in array)


def _noise(**deviations: float) -> Array:
    for name, value in deviations.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be finite and > 0, got {value!r}")
    return np.diag(np.square(list(deviations.values())))
