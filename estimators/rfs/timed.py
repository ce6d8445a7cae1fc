"""Scans by their time stamps, also late ones: a tracker that knows the clock."""

from __future__ import annotations

import bisect
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from numpy.typing import ArrayLike

from servotrack.estimators.rfs.sensors import Sensor
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LARGEST_NUMBER, LIMITS, as_numbers, checked_number

StateT = TypeVar("StateT")


class TimedFilter(Protocol[StateT]):
    """A set filter whose steps take an interval and a sensor."""

    def initial(self, measurement: ArrayLike, sensor: Sensor | None = None) -> StateT:
        """State before the first scan."""

    def step(
        self,
        state: StateT,
        measurement: ArrayLike,
        dt: float | None = None,
        sensor: Sensor | None = None,
        noise: ArrayLike | None = None,
    ) -> tuple[StateT, SetEstimate]:
        """Predict over an interval and update with a scan of a sensor."""


_TIME_RULE = f"finite, at most {LIMITS.times:g} s from 0"


class _Scan(NamedTuple):
    """A scan with the state after it."""

    time: float
    measurements: Array
    sensor: Sensor | None
    noise: Array | None
    state: Any


class TimedTracker(Generic[StateT]):
    """A set filter that takes scans with time stamps, from several sensors and in any order.

    A scan that arrives late is put in its place: the filter goes back to the state before it and steps through the
    later scans again. States are values, so nothing else is needed; it costs one step per later scan.

    Args:
        filter: The filter, whose model serves varying intervals.
        memory: Largest delay of a scan, s. Raising it keeps more states and takes scans that are later.

    Attributes:
        time: Time of the newest scan, s; None before the first.
        estimate: Estimate after the newest scan; None before the first.

    Raises:
        ValueError: `memory` is negative.
    """

    def __init__(self, filter: TimedFilter[StateT], memory: float = 10.0) -> None:
        self.filter = filter
        self.memory = checked_number("memory", memory, 0.0, LARGEST_NUMBER, "finite and >= 0")
        self.time: float | None = None
        self.estimate: SetEstimate | None = None
        self._scans: list[_Scan] = []
        self._forgotten = False

    def update(
        self, measurements: ArrayLike, time: float, sensor: Sensor | None = None, noise: ArrayLike | None = None
    ) -> SetEstimate:
        """Take a scan and return the estimate at the time of the newest one.

        Args:
            measurements: Shape (Z, m); Z may be 0.
            time: Time of the scan, s, from any origin. Scans of one time are updates of one instant.
            sensor: Sensor of the scan; None: the measurement of the filter's model.
            noise: Covariance of each measurement's noise, where they differ; None: that of the sensor. Shape (Z, m, m).

        Raises:
            ValueError: The time is not finite, or before all scans in memory; measurements are refused by the filter.
                Such a scan changes nothing.
        """
        time = checked_number("time", time, -LIMITS.times, LIMITS.times, _TIME_RULE)
        place = len(self._scans)
        while place > 0 and self._scans[place - 1].time > time:
            place -= 1
        if place == 0 and self._forgotten:
            raise ValueError(
                f"time must be at least {self._scans[0].time!r}, the oldest scan in memory, got {time!r}; raise memory "
                f"above {self.memory:g} s to take scans that are later"
            )
        own = None if noise is None else as_numbers("noise", noise).copy()
        waiting = [(time, as_numbers("measurements", measurements).copy(), sensor, own)]
        waiting += [(scan.time, scan.measurements, scan.sensor, scan.noise) for scan in self._scans[place:]]
        replayed: list[_Scan] = []
        last = self._scans[place - 1] if place > 0 else None
        for then, z, seen_by, spread in waiting:
            if last is None:
                # The first scan comes a period after nothing.
                state, dt = self.filter.initial(z, seen_by), None
            else:
                state, dt = last.state, then - last.time
            state, estimate = self.filter.step(state, z, dt, seen_by, spread)
            last = _Scan(then, z, seen_by, spread, state)
            replayed.append(last)
        self._scans[place:] = replayed
        self.time, self.estimate = replayed[-1].time, estimate
        first = bisect.bisect_left(self._scans, self.time - self.memory, key=lambda scan: scan.time)
        # One state older than the memory is kept: a scan at its edge starts from it.
        if first > 1:
            del self._scans[: first - 1]
            self._forgotten = True
        return estimate

    def reset(self) -> None:
        """Forget all scans."""
        self.time, self.estimate, self._scans, self._forgotten = None, None, [], False
