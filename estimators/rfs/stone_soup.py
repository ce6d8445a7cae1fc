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
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.models.base import LinearModel, ReversibleModel
from stonesoup.tracker import Tracker
from stonesoup.types.angle import Angle
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState, State
from stonesoup.types.track import Track

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

    Detections of one time that have different measurement models are scans of different sensors, as are detections
    that arrive later with an earlier time stamp.

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
        for model, rows in self._scans(detections):
            estimate = self._tracker.update(rows, seconds, self._sensor(model))
        held = {int(label) for label in (*estimate.labels, *estimate.held_labels) if label > 0}
        self._tracks = {label: track for label, track in self._tracks.items() if label in held}
        for label, mean, covariance in zip(estimate.labels, estimate.states, estimate.covariances, strict=True):
            state = GaussianState(StateVector(mean), covariance, timestamp=time)
            self._tracks.setdefault(int(label), Track(id=str(label))).append(state)
        return time, self.tracks

    def _scans(self, detections: set[Detection]) -> list[tuple[Any, Array]]:
        """Detections by measurement model, in an order that does not depend on that of the set."""
        scans: dict[int, tuple[Any, list[tuple[float, ...]]]] = {}
        for detection in detections:
            model = detection.measurement_model or self.measurement_model
            if model is None:
                raise ValueError("measurement_model must be given to the tracker, since a detection has none")
            row = tuple(float(entry) for entry in np.ravel(detection.state_vector))
            scans.setdefault(id(model), (model, []))[1].append(row)
        found = [(model, as_numbers("detections of one model", sorted(rows))) for model, rows in scans.values()]
        found.sort(key=lambda scan: (scan[1].shape[1], scan[1].tolist()))
        return found or [(self.measurement_model, np.zeros((0, self.measurement_model.ndim_meas)))]

    def _sensor(self, model: Any) -> Sensor:
        known = self._sensors.get(id(model))
        if known is None:
            known = self._sensors[id(model)] = (model, sensor_of(model))
        return known[1]


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
