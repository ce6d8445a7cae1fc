"""Stone Soup with the set filters here: its models and detections in, its tracks out.

    filter = PMB(target_model(transition, measurement), MeasurementBirth(0.1, 20.0), clutter_intensity=1e-6)
    for time, tracks in SetFilterTracker(detector, filter, measurement):
        ...

The tracks are Stone Soup's own, so its metrics, plotters and writers take them. Importing this module needs the package
`stonesoup`, tested with 1.9.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from stonesoup.base import Property
from stonesoup.models.base import LinearModel, ReversibleModel
from stonesoup.tracker import Tracker
from stonesoup.types.angle import Angle
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, State
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate

from servotrack.estimators.rfs.matching import match_measurements
from servotrack.estimators.rfs.models import HiddenMarkovModel, TargetModel
from servotrack.estimators.rfs.sensors import (
    FunctionSensor,
    Intensity,
    LinearSensor,
    Places,
    Probability,
    Sensor,
    sensed,
)
from servotrack.estimators.rfs.timed import TimedFilter, TimedTracker
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import as_numbers


@dataclass(frozen=True)
class TransitionMotion:
    """Motion by a linear Gaussian transition model of Stone Soup.

    Args:
        transition: The transition model.
    """

    transition: Any

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition (n, n) and process noise (n, n) over `dt` seconds."""
        interval = datetime.timedelta(seconds=dt)
        F = np.asarray(self.transition.matrix(time_interval=interval), dtype=np.float64)
        return F, np.asarray(self.transition.covar(time_interval=interval), dtype=np.float64)


def target_model(transition: Any, measurement: Any, period: float = 1.0) -> TargetModel:
    """Model of one target from Stone Soup's models.

    Args:
        transition: A linear Gaussian transition model.
        measurement: A Gaussian measurement model.
        period: Interval that survival and expected births are for, s.

    Raises:
        ValueError: The transition model is not linear.
    """
    if not isinstance(transition, LinearModel):
        raise ValueError(f"transition must be a linear Gaussian model, got {type(transition).__name__}")
    motion = TransitionMotion(transition)
    F, Q = motion(period)
    n = len(F)
    still = HiddenMarkovModel(F, Q, np.eye(n), np.eye(n), motion, period)
    return sensed(still, sensor_of(measurement))


def sensor_of(
    measurement: Any, *, detection: Probability | None = None, clutter_intensity: Intensity | None = None
) -> Sensor:
    """Sensor with a measurement model of Stone Soup.

    Tracks start at its measurements if the model can be inverted (`ReversibleModel`).

    Args:
        measurement: A Gaussian measurement model.
        detection: Detection probability; None: the filter's.
        clutter_intensity: Expected false measurements per scan and unit of measurement space; None: the filter's.
    """
    noise = np.asarray(measurement.covar(), dtype=np.float64)
    if isinstance(measurement, LinearModel):
        H = np.asarray(measurement.matrix(), dtype=np.float64)
        return LinearSensor(H, noise, detection=detection, clutter_intensity=clutter_intensity)
    example = measurement.function(State(StateVector(np.ones(measurement.ndim_state))), noise=False)
    angular = np.array([isinstance(entry, Angle) for entry in np.ravel(np.asarray(example, dtype=object))])
    return FunctionSensor(
        _Measured(measurement),
        noise,
        angular=angular,
        position=tuple(int(entry) for entry in measurement.mapping),
        places=_Inverted(measurement, noise, angular) if isinstance(measurement, ReversibleModel) else None,
        detection=detection,
        clutter_intensity=clutter_intensity,
    )


class SetFilterTracker(Tracker):  # type: ignore[misc]
    """A set filter as a tracker of Stone Soup.

    Detections of one time that have different measurement models are scans of different sensors, but linear models that
    differ in their noise only are one sensor with a noise for each detection. Detections may arrive late. A track takes
    the metadata of the detection that is most probably its own (`match_measurements`).

    Args:
        detector: Iterable of times and sets of detections, or None to call `update_tracker`.
        filter: The filter, with a model of `target_model`.
        measurement_model: Measurement model of detections that have none, and of scans without detections.
        sensors: Sensors by measurement model, where `sensor_of(measurement_model)` does not say enough.
        memory: Largest delay of a scan, s.
    """

    detector: Any = Property(doc="Iterable of times and sets of detections")
    filter: Any = Property(doc="Set filter of servotrack")
    measurement_model: Any = Property(doc="Measurement model of detections that have none")
    sensors: Any = Property(default=None, doc="List of pairs of a measurement model and its sensor")
    memory: float = Property(default=10.0, doc="Largest delay of a scan, s")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        filter: TimedFilter[Any] = self.filter
        self._tracker: TimedTracker[Any] = TimedTracker(filter, self.memory)
        self._start: datetime.datetime | None = None
        self._tracks: dict[int, Track] = {}
        # The models stay referenced here, so that the address of one cannot become that of another.
        given = self.sensors or ()
        self._sensors: dict[int, tuple[Any, Sensor]] = {id(model): (model, sensor) for model, sensor in given}
        self._linear: dict[Any, Sensor] = {}
        self._iterator: Iterator[Any] | None = None

    @property
    def tracks(self) -> set[Track]:
        """Tracks that the filter still holds."""
        return set(self._tracks.values())

    def __iter__(self) -> SetFilterTracker:
        if self._iterator is None:
            self._iterator = iter(self.detector)
        return self

    def __next__(self) -> tuple[datetime.datetime, set[Track]]:
        if self._iterator is None:
            self._iterator = iter(self.detector)
        return self.update_tracker(*next(self._iterator))

    def update_tracker(
        self, time: datetime.datetime, detections: set[Detection]
    ) -> tuple[datetime.datetime, set[Track]]:
        """Take the detections of one time and return the tracks after it.

        Raises:
            ValueError: The time is no datetime, or has a time zone unlike the first one; a detection has no measurement
                model, or is refused by the filter.
        """
        start = self._start or time
        if not isinstance(time, datetime.datetime) or (time.tzinfo is None) != (start.tzinfo is None):
            raise ValueError(f"time must be a datetime, all with a time zone or all without, got {time!r}")
        seconds = (time - start).total_seconds()
        self._start = start
        scans = self._scans(detections)
        for scan in scans:
            estimate = self._tracker.update(scan.rows, seconds, scan.sensor, scan.noise)
        found: list[Detection | None] = [None] * len(estimate.labels)
        # A late scan is older than the estimate.
        for scan in scans if self._tracker.time == seconds else []:
            matched = match_measurements(estimate, scan.rows, self.filter.model, sensor=scan.sensor, noise=scan.noise)
            found = [scan.detections[row] if row >= 0 else one for one, row in zip(found, matched, strict=True)]
        held = {int(label) for label in (*estimate.labels, *estimate.held_labels) if label > 0}
        self._tracks = {label: track for label, track in self._tracks.items() if label in held}
        for label, mean, covariance, detection in zip(
            estimate.labels, estimate.states, estimate.covariances, found, strict=True
        ):
            if detection is None:
                state = GaussianState(StateVector(mean), covariance, timestamp=time)
            else:
                hypothesis = SingleHypothesis(None, detection)
                state = GaussianStateUpdate(StateVector(mean), covariance, hypothesis=hypothesis, timestamp=time)
            self._tracks.setdefault(int(label), Track(id=str(label))).append(state)
        return time, self.tracks

    def _scans(self, detections: set[Detection]) -> list[_Scan]:
        """Detections by sensor, in an order that does not depend on that of the set."""
        groups: dict[Any, list[tuple[list[float], list[float], Any, Detection]]] = {}
        for detection in detections:
            model = detection.measurement_model or self.measurement_model
            if model is None:
                raise ValueError("measurement_model must be given to the tracker, since a detection has none")
            row = np.ravel(np.asarray(detection.state_vector, dtype=np.float64)).tolist()
            own = np.ravel(np.asarray(model.covar(), dtype=np.float64)).tolist()
            groups.setdefault(self._kind(model), []).append((row, own, model, detection))
        found = []
        for kind, members in groups.items():
            members.sort(key=lambda member: member[:2])
            rows, noises, models, seen = zip(*members, strict=True)
            sensor, m = self._sensor(kind, models[0]), len(rows[0])
            noise: Array | None = None
            if any(one != np.ravel(sensor.noise).tolist() for one in noises):
                noise = np.array(noises).reshape(-1, m, m)
            found.append(_Scan(sensor, as_numbers("detections of one model", list(rows)), noise, list(seen)))
        found.sort(key=lambda scan: (scan.rows.shape[1], scan.rows.tolist()))
        if not found:
            model = self.measurement_model
            found.append(_Scan(self._sensor(self._kind(model), model), np.zeros((0, model.ndim_meas)), None, []))
        return found

    def _kind(self, model: Any) -> Any:
        """Key of the scan that a detection belongs to: the matrix of a linear model, else the model."""
        if id(model) in self._sensors or not isinstance(model, LinearModel):
            return id(model)
        H = np.asarray(model.matrix(), dtype=np.float64)
        return H.shape, H.tobytes()

    def _sensor(self, kind: Any, model: Any) -> Sensor:
        if isinstance(kind, int):
            return self._sensors.setdefault(kind, (model, sensor_of(model)))[1]
        if kind not in self._linear:
            self._linear[kind] = sensor_of(model)
        return self._linear[kind]


class _Scan(NamedTuple):
    """Detections of one sensor at one time; the noise of each if they differ."""

    sensor: Sensor
    rows: Array
    noise: Array | None
    detections: list[Detection]


@dataclass(frozen=True)
class _Measured:
    """The measurement function of a model for many states."""

    model: Any

    def __call__(self, states: Array) -> Array:
        found = self.model.function(State(StateVectors(states.T)), noise=False)
        return np.asarray(found, dtype=np.float64).T


@dataclass(frozen=True, eq=False)
class _Inverted:
    """Positions of measurements by the inverse of a model, with the covariance of the first-order transform."""

    model: Any
    noise: Array
    angular: Mask

    def __call__(self, z: Array) -> Places:
        axes = [int(entry) for entry in self.model.mapping]
        states = np.array([np.ravel(self.model.inverse_function(Detection(StateVector(row)))) for row in z], np.float64)
        precision = np.linalg.inv(self.noise)
        covariance = np.empty((len(z), 1, len(axes), len(axes)))
        for k, state in enumerate(states):
            slope = self._slope(state, axes)
            covariance[k, 0] = np.linalg.pinv(slope.T @ precision @ slope, hermitian=True)
        return Places(states[:, None, axes], covariance)

    def _slope(self, state: Array, axes: list[int]) -> Array:
        """Derivative of the measurement with respect to the position, by central differences. Shape (m, d)."""
        step = 1e-4 * max(1.0, float(np.abs(state[axes]).max()))
        moved = np.repeat(state[None], 2 * len(axes), axis=0)
        for k, axis in enumerate(axes):
            moved[2 * k, axis] += step
            moved[2 * k + 1, axis] -= step
        values = _Measured(self.model)(moved)
        difference = values[::2] - values[1::2]
        turns = np.where(self.angular, np.round(difference / (2.0 * math.pi)), 0.0)
        difference -= 2.0 * math.pi * turns
        return difference.T / (2.0 * step)
