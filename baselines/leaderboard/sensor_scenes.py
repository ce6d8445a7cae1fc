"""Scenes of several, asynchronous and moving sensors, for comparisons with other libraries' trackers.

A scene is a list of scans with their truth. Ten targets with nearly constant velocity start and end at times of their
own, inside a square of 4 km.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.metrics import Track
from servotrack.estimators.rfs import (
    HiddenMarkovModel,
    LinearSensor,
    bearing_sensor,
    constant_velocity,
    spherical_sensor,
)
from servotrack.estimators.rfs.sensors import Sensor
from servotrack.estimators.types import Array

SIZE = 4000.0
"""Side of the square in which targets start, m."""
TARGETS = 10


class SceneScan(NamedTuple):
    """Measurements of one sensor at one time.

    Attributes:
        time: Time, s.
        kind: Name of the sensor.
        sensor: The sensor.
        measurements: Measurements in random order. Shape (Z, m).
    """

    time: float
    kind: str
    sensor: Sensor
    measurements: Array


@dataclass(frozen=True, eq=False)
class SensorScene:
    """A drawn scene.

    Attributes:
        model: Motion of a target, and a measurement of its position.
        scans: Scans in order of time.
        truth: True positions at the times of the scans.
        position: Indices of the position in the state.
        speed: Standard deviation of the velocity of a new target along an axis, m/s.
        cutoff: Distance at which the similarity of HOTA reaches 0, m.
    """

    model: HiddenMarkovModel
    scans: Sequence[SceneScan]
    truth: Sequence[Track]
    position: tuple[int, ...]
    speed: float
    cutoff: float


def two_sensors(seed: int, scans: int = 100) -> SensorScene:
    """Positions of a sharp sensor every second and of a blunt one every 1.7 s."""
    model = constant_velocity(1.0, 10.0)
    area = SIZE**2
    sharp = LinearSensor(model.observation, 100.0 * np.eye(2), detection=0.9, clutter_intensity=10.0 / area)
    blunt = LinearSensor(model.observation, 900.0 * np.eye(2), detection=0.8, clutter_intensity=5.0 / area)
    times = sorted([(1.0 * k, "sharp") for k in range(scans)] + [(0.5 + 1.7 * k, "blunt") for k in range(scans)])[
        :scans
    ]
    kinds = {"sharp": (sharp, 10.0), "blunt": (blunt, 5.0)}
    return _draw(model, [(time, kind, kinds[kind][0], kinds[kind][1]) for time, kind in times], seed)


def radar(seed: int, scans: int = 100) -> SensorScene:
    """Azimuth, elevation, range and range rate at intervals of 1 to 3 s, in three dimensions."""
    model = constant_velocity(1.0, 10.0, dimensions=3)
    volume = 2.0 * np.pi * 0.6 * 6000.0 * 120.0
    sensor = spherical_sensor(
        0.005, 0.005, 10.0, 1.0, at=(-500.0, -500.0, 0.0), detection=0.9, clutter_intensity=10.0 / volume
    )
    times = np.cumsum(np.random.default_rng([seed, 1]).uniform(1.0, 3.0, scans))
    return _draw(model, [(float(time), "radar", sensor, 10.0) for time in times], seed)


def reports(seed: int, scans: int = 100) -> SensorScene:
    """Positions that ships report by themselves now and then, in groups of 5 to 15 s, without false ones (AIS)."""
    model = constant_velocity(0.2, 10.0)
    sensor = LinearSensor(model.observation, 100.0 * np.eye(2), detection=0.6, clutter_intensity=1e-3 / SIZE**2)
    times = np.cumsum(np.random.default_rng([seed, 1]).uniform(5.0, 15.0, scans))
    return _draw(model, [(float(time), "report", sensor, 0.0) for time in times], seed)


def bearings(seed: int, scans: int = 100) -> SensorScene:
    """Bearings every 10 s from a ship that zigzags."""
    model = constant_velocity(0.05, 10.0)
    taken = []
    for k in range(scans):
        time = 10.0 * k
        ship = (4.0 * time - SIZE / 2.0, -SIZE + 600.0 * float(np.sin(time / 120.0)))
        sensor = bearing_sensor(
            0.01, at=ship, distances=(500.0, 8000.0), detection=0.9, clutter_intensity=1.0 / (2.0 * np.pi)
        )
        taken.append((time, "bearing", sensor, 1.0))
    # A bearing says little of the distance, so a wider neighborhood counts as found.
    return _draw(model, taken, seed, targets=3, speed=2.0, cutoff=1000.0)


SCENES: Mapping[str, Callable[..., SensorScene]] = {
    "two asynchronous sensors": two_sensors,
    "radar with range rate, 3-D": radar,
    "ships that report (AIS)": reports,
    "bearings from a moving ship": bearings,
}
"""Functions of seed and number of scans, by the name in tables."""


def _draw(
    model: HiddenMarkovModel,
    taken: Sequence[tuple[float, str, Sensor, float]],
    seed: int,
    *,
    targets: int = TARGETS,
    speed: float = 15.0,
    cutoff: float = 100.0,
) -> SensorScene:
    """Draw targets, measurements and false measurements; the last entry of `taken` is the clutter's mean number."""
    rng = np.random.default_rng([seed, 0])
    n = model.transition.shape[0]
    position = tuple(range(0, n, 2))
    last = taken[-1][0]
    tracks = []
    for _ in range(targets):
        x = np.zeros(n)
        x[::2] = rng.uniform(-SIZE / 2.0, SIZE / 2.0, n // 2)
        x[1::2] = speed * rng.standard_normal(n // 2)
        if n == 6:
            x[4], x[5] = rng.uniform(300.0, 1500.0), 0.2 * x[5]
        start, end = np.sort(rng.uniform(-0.3 * last, 1.3 * last, 2))
        if end - start < 0.3 * last:
            start, end = max(start - 0.2 * last, -0.3 * last), end + 0.2 * last
        steps, states, before = [], [], None
        for step, (time, *_) in enumerate(taken):
            if before is not None and time > before:
                F, Q = model.motion(time - before)  # type: ignore[misc]
                x = F @ x + np.linalg.cholesky(Q) @ rng.standard_normal(n)
            if start <= time <= end:
                steps.append(step)
                states.append(x)
            before = time
        tracks.append((np.array(steps, np.int64), np.array(states).reshape(len(steps), n)))
    scans = []
    for step, (time, kind, sensor, clutter) in enumerate(taken):
        rows = []
        for own_steps, own_states in tracks:
            found = np.flatnonzero(own_steps == step)
            if len(found) and rng.random() < float(np.asarray(sensor.detection)):
                rows.append(_measured(sensor, own_states[found[0]]) + _noise(sensor, rng))
        for _ in range(rng.poisson(clutter)):
            rows.append(_false(sensor, rng))
        z = np.array(rows).reshape(len(rows), sensor.size)
        scans.append(SceneScan(time, kind, sensor, rng.permutation(z)))
    truth = [Track(own_steps, own_states[:, list(position)]) for own_steps, own_states in tracks if len(own_steps)]
    return SensorScene(model, scans, truth, position, speed, cutoff)


def _measured(sensor: Sensor, state: Array) -> Array:
    if isinstance(sensor, LinearSensor):
        return np.asarray(sensor.observation @ state)
    return np.asarray(sensor.function(state[None])[0])


def _noise(sensor: Sensor, rng: np.random.Generator) -> Array:
    return np.asarray(np.linalg.cholesky(sensor.noise) @ rng.standard_normal(sensor.size))


def _false(sensor: Sensor, rng: np.random.Generator) -> Array:
    """A false measurement: uniform over the square, over all bearings, or over the radar's field."""
    if isinstance(sensor, LinearSensor):
        return rng.uniform(-SIZE / 2.0, SIZE / 2.0, 2)
    if sensor.size == 1:
        return rng.uniform(-np.pi, np.pi, 1)
    return rng.uniform([-np.pi, -0.1, 0.0, -60.0], [np.pi, 0.5, 6000.0, 60.0])
