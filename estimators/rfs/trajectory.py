"""Tracks as objects: the state, covariance and existence of one identity over time, from any set filter's estimates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.recursion import GaussianSetFilter
from servotrack.estimators.rfs.sensors import Sensor
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.rfs.trajectory_pmb import TrajectoryPMB
from servotrack.estimators.types import Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One identity over time.

    Attributes:
        label: Identity, at least 1.
        times: Times of the scans in which it was reported, increasing, s. Shape (T,).
        states: Reported states. Shape (T, n).
        covariances: Covariances of the states. Shape (T, n, n).
        existence: Probabilities of existence. Shape (T,).

    Raises:
        ValueError: Shapes disagree, or the times do not increase.
    """

    label: int
    times: Array
    states: Array
    covariances: Array
    existence: Array

    def __post_init__(self) -> None:
        T, n = np.shape(self.states) if np.ndim(self.states) == 2 else (0, 0)
        for name, shape in (
            ("times", (T,)),
            ("states", (T, n)),
            ("covariances", (T, n, n)),
            ("existence", (T,)),
        ):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"{name} must have shape {shape} as states (T, n), got {value.shape}")
            object.__setattr__(self, name, value)
        if T == 0 or not np.all(np.diff(self.times) > 0.0):
            raise ValueError(f"times must increase and not be empty, got {self.times.tolist()} for label {self.label}")

    def __len__(self) -> int:
        return len(self.times)


def collect_trajectories(times: Sequence[float], estimates: Iterable[SetEstimate]) -> list[Trajectory]:
    """Collect the reported targets of successive estimates by identity.

    Args:
        times: Time that each estimate is for, increasing, s. A smoother's estimate is for an earlier scan than its
            newest one.
        estimates: Estimates of one run.

    Returns:
        Trajectories in order of their first report. A scan in which an identity is not reported leaves a gap.

    Raises:
        ValueError: The numbers of times and estimates differ, an estimate is of a batch, or the times do not increase.
    """
    found: dict[int, list[tuple[float, Array, Array, float]]] = {}
    given = list(estimates)
    if len(times) != len(given):
        raise ValueError(f"times must be as many as estimates, got {len(times)} and {len(given)}")
    for time, estimate in zip(times, given, strict=True):
        if np.ndim(estimate.labels) != 1:
            raise ValueError(f"estimates must be of one run, got labels of shape {np.shape(estimate.labels)}")
        for k, label in enumerate(estimate.labels.tolist()):
            row = (float(time), estimate.states[k], estimate.covariances[k], float(estimate.existence[k]))
            found.setdefault(label, []).append(row)
    return [Trajectory(label, *map(np.array, zip(*rows, strict=True))) for label, rows in found.items()]


def track_scans(
    tracker: GaussianSetFilter[Any],
    scans: Iterable[ArrayLike],
    times: ArrayLike,
    sensors: Sequence[Sensor | None] | None = None,
    noises: Sequence[ArrayLike | None] | None = None,
) -> list[Trajectory]:
    """Filter recorded scans and return the trajectories; a smoother's last scans are flushed.

    Args:
        tracker: A Gaussian set filter, such as `PMB`, or a smoother, such as `TrajectoryPMB`.
        scans: Measurements of each scan. Shape (Z, m), Z may be 0.
        times: Time of each scan, increasing, s. Shape (K,).
        sensors: Sensor of each scan; None: the measurement of the filter's model.
        noises: Covariances (Z, m, m) of the noise of each scan's measurements; None: those of the sensor.

    Raises:
        ValueError: Times do not increase, are not finite or not as many as scans, or the filter refuses a scan.
    """
    clock, given = np.asarray(times, dtype=np.float64), list(scans)
    if clock.shape != (len(given),) or not np.all(np.isfinite(clock)) or not np.all(np.diff(clock) > 0.0):
        raise ValueError(
            f"times must be finite, increasing and as many as the {len(given)} scans, got shape {clock.shape}"
        )
    smoother = tracker if isinstance(tracker, TrajectoryPMB) else None
    estimates: list[SetEstimate] = []
    state = None
    for k, scan in enumerate(given):
        sensor = None if sensors is None else sensors[k]
        if state is None:
            state = tracker.initial(scan, sensor)
        dt = None if k == 0 else float(clock[k] - clock[k - 1])
        state, estimate = tracker.step(state, scan, dt, sensor, None if noises is None else noises[k])
        estimates.append(estimate)
    if smoother is not None and state is not None:
        estimates = [*estimates[smoother.lag :], *smoother.flush(state)[-len(given) :]]
    return collect_trajectories(clock.tolist(), estimates)
