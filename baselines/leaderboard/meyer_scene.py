"""Five targets that meet in the middle between two radars: a published scenario with two sensors at each time.

`ClutterTracking-v0` has one sensor, so that set filters play this scene directly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.rfs import (
    GMPHD,
    LMB,
    PMB,
    PMBM,
    MeasurementBirth,
    TimedTracker,
    constant_velocity,
    range_bearing_sensor,
)
from servotrack.estimators.rfs.sensors import FunctionSensor
from servotrack.estimators.types import Array

MEYER_SOURCE = (
    "public code of Meyer, Braca, Willett and Hlawatsch, IEEE Transactions on Signal Processing 65(13), 2017, and of "
    "Meyer et al., Proceedings of the IEEE 106(2), 2018 (meyer-ucsd/MTT-PIEEE-18): five targets that meet in the "
    "middle of 200 scans of two sensors of range and bearing"
)
MEYER_DIFFERENCES = (
    "filters have Gaussians, no particles; process noise of continuous time, T^3/3 instead of T^4/4; new targets are "
    "expected at the last measurements"
)

SCANS = 200
STARTS, SPEED, ACCELERATION = 1000.0, 10.0, 0.1
"""Distance of the first positions from the middle, m; speed towards it, m/s; standard deviation of the noise, m/s^2."""
LIVES = ((5, 155), (10, 160), (15, 165), (20, 170), (25, 175))
"""First and last scan of each target, counted from 1."""
SENSORS = ((0.0, 5000.0), (0.0, -5000.0))
REACH, FALSE = 6000.0, 5.0
"""Largest range of a false measurement, m, and their mean number in a scan of a sensor."""
DETECTION, SURVIVAL, APPEARING = 0.9, 0.999, 0.01
RANGE_NOISE, BEARING_NOISE = 25.0, float(np.deg2rad(0.5))
CLUTTER = FALSE / (REACH * 2.0 * np.pi)
"""Intensity of false measurements of one sensor, per m and rad."""


class MeyerScene(NamedTuple):
    """A drawn scene.

    Attributes:
        truth: True positions at each scan, m. Shape (n, 2) each.
        scans: Ranges (m) and bearings (rad) at each scan, one array for each sensor. Shape (Z, 2) each.
    """

    truth: list[Array]
    scans: list[tuple[Array, Array]]


def meyer_scene(seed: int) -> MeyerScene:
    """Draw a scene.

    Args:
        seed: Any non-negative integer.
    """
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(len(LIVES)) / len(LIVES)
    toward = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    place, velocity = STARTS * toward, -SPEED * toward
    truth: list[Array] = []
    scans: list[tuple[Array, Array]] = []
    for scan in range(1, SCANS + 1):
        if scan > 1:
            push = ACCELERATION * rng.standard_normal(place.shape)
            place, velocity = place + velocity + 0.5 * push, velocity + push
        there = np.array([first <= scan <= last for first, last in LIVES])
        truth.append(place[there])
        seen = [_measured(place[there], np.array(at), rng) for at in SENSORS]
        scans.append((seen[0], seen[1]))
    return MeyerScene(truth, scans)


def _measured(places: Array, at: Array, rng: np.random.Generator) -> Array:
    """Measurements of one sensor in random order. Shape (Z, 2)."""
    offset = places - at
    exact = np.stack([np.hypot(offset[:, 0], offset[:, 1]), np.arctan2(offset[:, 1], offset[:, 0])], axis=1)
    noisy = exact + rng.standard_normal(exact.shape) * [RANGE_NOISE, BEARING_NOISE]
    found = noisy[rng.random(len(places)) < DETECTION]
    false = rng.uniform([0.0, -np.pi], [REACH, np.pi], (rng.poisson(FALSE), 2))
    return rng.permutation(np.concatenate([found, false]))


def _filter(kind: Callable[..., Any]) -> Callable[[], Any]:
    """Return a function that makes a filter of a kind with the scene's model."""

    def make() -> Any:
        births = MeasurementBirth(expected=APPEARING, hidden_deviation=10.0)
        model = constant_velocity(ACCELERATION, RANGE_NOISE)
        return kind(model, births, clutter_intensity=CLUTTER, survival=SURVIVAL, detection=DETECTION)

    return make


MEYER_FILTERS: Mapping[str, Callable[[], Any]] = {
    "gm-phd": _filter(GMPHD),
    "lmb": _filter(LMB),
    "pmb": _filter(PMB),
    "pmbm": _filter(PMBM),
}
"""Filters of the scene."""


def tracked(scene: MeyerScene, make: Callable[[], Any]) -> tuple[list[Array], list[Array]]:
    """Return the true positions, and those that a filter reports after both sensors of each scan."""
    sensors = [_sensor(at) for at in SENSORS]
    tracker = TimedTracker(make())
    found = []
    for time, scan in enumerate(scene.scans):
        for z, sensor in zip(scan, sensors, strict=True):
            estimate = tracker.update(z, float(time), sensor)
        found.append(estimate.states[:, [0, 2]])
    return scene.truth, found


def _sensor(at: tuple[float, float]) -> FunctionSensor:
    return range_bearing_sensor(RANGE_NOISE, BEARING_NOISE, at=at, detection=DETECTION, clutter_intensity=CLUTTER)
