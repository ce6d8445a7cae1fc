"""Sensors beside a filter's own: linear ones, and any function of the state.

A sensor passed to `step(..., sensor=)` replaces the measurement of the filter's model for that scan: what is measured,
how exactly, how often a target is seen and how much clutter there is. The joint Gaussian of state and measurement of a
function comes from the unscented transform, or from the function's Jacobian if there is one (Julier and Uhlmann 1997).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.definite import LEAST_SHARE
from servotrack.estimators.rfs.gaussians import FUNCTION, PackedModel, pack_model
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.rfs.models import (
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    TargetModel,
    checked_covariance,
    checked_matrix,
    moved,
)
from servotrack.estimators.rfs.motion import Motion
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, check_within, checked_number

Probability = float | Callable[[Array], Array]
"""A constant in [0, 1], or a function of states (k, n) that returns (k,)."""

Intensity = float | Callable[[Array], Array]
"""A constant, or a function of measurements (Z, m) that returns (Z,)."""


_LARGEST = LIMITS.coordinates**2
"""Largest magnitude of what a caller's function returns; the square of a measurement's limit."""


class Places(NamedTuple):
    """Possible positions of a target that caused a measurement: equally probable Gaussians, c per measurement.

    Attributes:
        mean: Positions. Shape (k, c, d).
        covariance: Covariances of the positions. Shape (k, c, d, d).
    """

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class LinearSensor:
    """A sensor that measures y = H x + v.

    Args:
        observation: H. Shape (m, n).
        noise: R, the covariance of v, positive definite. Shape (m, m).
        detection: Detection probability, a number or a function of states (k, n) that returns (k,). None: the filter's.
        clutter_intensity: Expected false measurements per scan and unit of measurement space, a number or a function of
            measurements (Z, m). None: the filter's, which fits if both measure in the same units.

    Raises:
        ValueError: A matrix has a wrong shape, or the noise is not positive definite.
    """

    observation: Array
    noise: Array
    _: KW_ONLY
    detection: Probability | None = None
    clutter_intensity: Intensity | None = None

    def __post_init__(self) -> None:
        H = checked_matrix("observation", self.observation, (None, None))
        object.__setattr__(self, "observation", H)
        object.__setattr__(self, "noise", checked_covariance("noise", self.noise, H.shape[0], definite=True))

    @property
    def size(self) -> int:
        """Entries of one measurement, m."""
        return int(self.observation.shape[0])


@dataclass(frozen=True, eq=False)
class FunctionSensor:
    """A sensor that measures y = h(x) + v.

    Args:
        function: h, from states (k, n) to measurements (k, m). It may be compiled.
        noise: R, the covariance of v, positive definite. Shape (m, m).
        angular: Mask of the entries of y that are angles in rad, whose differences wrap at +-pi. Shape (m,); None:
            none.
        jacobian: Derivative of h, from states (k, n) to (k, m, n). With it h is linearized at the mean; None: the
            unscented transform, with 2 n + 1 values of h per Gaussian.
        position: Indices of the state entries that are the position, for births at measurements.
        places: Function of measurements (k, m) that returns the `Places` of targets with them. None: this sensor's
            measurements start no tracks by themselves.
        detection: Detection probability; see `LinearSensor`.
        clutter_intensity: Expected false measurements; see `LinearSensor`.

    Raises:
        ValueError: An argument has a wrong shape, or the noise is not positive definite.
    """

    function: Callable[[Array], Array]
    noise: Array
    _: KW_ONLY
    angular: ArrayLike | None = None
    jacobian: Callable[[Array], Array] | None = None
    position: tuple[int, ...] = (0, 2)
    places: Callable[[Array], Places] | None = None
    detection: Probability | None = None
    clutter_intensity: Intensity | None = None

    def __post_init__(self) -> None:
        R = np.asarray(self.noise, dtype=np.float64)
        if R.ndim != 2:
            raise ValueError(f"noise must have shape (m, m), got {R.shape}")
        object.__setattr__(self, "noise", checked_covariance("noise", R, len(R), definite=True))
        angular = np.zeros(len(R), np.bool_) if self.angular is None else np.array(self.angular, dtype=np.bool_)
        if angular.shape != (len(R),):
            raise ValueError(f"angular must have shape ({len(R)},), one entry per measured value, got {angular.shape}")
        object.__setattr__(self, "angular", angular)

    @property
    def size(self) -> int:
        """Entries of one measurement, m."""
        return len(self.noise)


Sensor = LinearSensor | FunctionSensor
"""What `step(..., sensor=)` takes."""


@dataclass(frozen=True, eq=False)
class SensedModel:
    """Motion of a target with the measurement of a `FunctionSensor`.

    Args:
        transition: F. Shape (n, n).
        process_noise: Q, positive semidefinite. Shape (n, n).
        sensor: The sensor.
        motion: Transition and process noise as functions of the interval; None: scans at the period only.
        period: Interval that `transition` and `process_noise` are for, s.
    """

    transition: Array
    process_noise: Array
    sensor: FunctionSensor
    motion: Motion | None = None
    period: float = 1.0

    def __post_init__(self) -> None:
        n, position = self.transition.shape[0], self.sensor.position
        if len(set(position)) != len(position) or not all(0 <= entry < n for entry in position):
            raise ValueError(f"sensor position must be indices of the {n} state entries, got {position!r}")

    def at(self, dt: float) -> SensedModel:
        """The same model for another interval; arguments and errors as in `TargetModel`."""
        if dt == self.period:
            return self
        return SensedModel(*moved(self, dt), self.sensor, self.motion, dt)

    @cached_property
    def packed(self) -> PackedModel:
        """Arrays of the model for the compiled kernels; `attach` computes what they cannot."""
        n, m = self.transition.shape[0], self.sensor.size
        B, sigma = np.zeros((n + m, n + m)), np.zeros((n + m, n + m))
        B[:n, :n], sigma[:n, :n] = self.transition, self.process_noise
        angular = tuple(bool(one) for one in np.asarray(self.sensor.angular))
        return pack_model(FUNCTION, False, B, sigma, np.zeros((m, n)), self.sensor.noise, angular=angular)

    def attach(self, mixture: Mixture) -> None:
        """Fill the y blocks of all components in use from their x blocks, in place.

        Raises:
            ValueError: The sensor's function or Jacobian returns a wrong shape, NaN or infinity.
        """
        used = np.arange(mixture.weight.shape[1]) < mixture.number[:, None]
        mean, covariance = mixture.mean[used], mixture.covariance[used]
        if len(mean) == 0:
            return
        n, m, sensor = self.transition.shape[0], self.sensor.size, self.sensor
        angular = np.asarray(sensor.angular)
        if sensor.jacobian is not None:
            # A caller's function may write into its argument.
            x = mean[:, :n]
            y = _checked("function", sensor.function(x.copy()), (len(x), m))
            H = _checked("jacobian", sensor.jacobian(x.copy()), (len(x), m, n))
            cross = np.einsum("krj,kjc->krc", H, covariance[:, :n, :n])
            mean[:, n:] = y
            covariance[:, n:, :n] = cross
            covariance[:, :n, n:] = np.swapaxes(cross, 1, 2)
            inner = np.einsum("krj,kcj->krc", cross, H)
            covariance[:, n:, n:] = 0.5 * (inner + np.swapaxes(inner, 1, 2)) + sensor.noise
        else:
            points, root = _sigma_points(mean, covariance, n)
            y = _checked("function", sensor.function(points.reshape(-1, n)), (points.shape[0] * points.shape[1], m))
            _join(n, y.reshape(*points.shape[:2], m), root, sensor.noise, angular, mean, covariance)
        mixture.mean[used], mixture.covariance[used] = mean, covariance

    def places(self, z: Array) -> Places | None:
        """Possible positions of targets with these measurements; None if the sensor does not say.

        Args:
            z: Measurements. Shape (k, m).

        Raises:
            ValueError: The sensor's `places` returns wrong shapes, NaN, infinity or indefinite covariances.
        """
        if self.sensor.places is None:
            return None
        found = self.sensor.places(z.copy())
        if not (isinstance(found, tuple) and len(found) == 2):
            raise ValueError(f"sensor places must return `Places`, means and covariances, got {type(found).__name__}")
        mean, covariance = (as_numbers("what the sensor's places returns", one) for one in found)
        d, c = len(self.sensor.position), mean.shape[1] if mean.ndim == 3 else 1
        places = _checked("places", mean, (len(z), c, d))
        spread = _checked("covariance of places", covariance, (len(z), c, d, d))
        scale = np.abs(spread).max(axis=(-1, -2), initial=0.0)
        skew = np.abs(spread - np.swapaxes(spread, -1, -2)).max(axis=(-1, -2), initial=0.0)
        rounding = LEAST_SHARE * scale
        if (skew > rounding).any() or (np.linalg.eigvalsh(spread)[..., 0] < -rounding).any():
            raise ValueError("sensor places must return symmetric positive semidefinite covariances")
        return Places(places, spread)


def model_at(model: TargetModel, dt: float | None, sensor: Sensor | None) -> TargetModel:
    """The model of a step.

    Args:
        model: Model of one target.
        dt: Interval before the scan, s; None: the model's period.
        sensor: Sensor of the scan; None: the measurement of the model.

    Raises:
        ValueError: dt is negative or not finite, or the model cannot serve it or the sensor.
    """
    interval = None if dt is None else checked_interval(dt)
    if sensor is not None:
        return sensed(model, sensor, interval)
    return model if interval is None else model.at(interval)


_INTERVAL_RULE = f"finite and >= 0, at most {LIMITS.times:g} s; for scans that arrive out of order use `TimedTracker`"


def checked_interval(dt: float) -> float:
    """Return an interval between scans, s, or raise ValueError if it is no number from 0 to the limit of clocks."""
    return checked_number("dt", dt, 0.0, LIMITS.times, _INTERVAL_RULE)


def sensed(model: TargetModel, sensor: Sensor, dt: float | None = None) -> TargetModel:
    """The motion of a model with the measurement of a sensor.

    Args:
        model: Model of one target.
        sensor: The sensor.
        dt: Interval before the scan, s; None: the model's period.

    Raises:
        ValueError: The model is pairwise, whose measurements are part of its motion, or the sensor has another state.
    """
    if isinstance(model, PairwiseMarkovModel):
        raise ValueError(
            "sensor must be None under a pairwise Markov model, whose measurements are one chain per target; use its "
            "hidden Markov model"
        )
    if not isinstance(model, HiddenMarkovModel | RangeBearingModel | SensedModel):
        raise ValueError(f"model must have a transition and a process noise for a sensor, got {type(model).__name__}")
    interval = model.period if dt is None else float(dt)
    if isinstance(sensor, LinearSensor):
        return HiddenMarkovModel.over(model, interval, sensor.observation, sensor.noise)
    if not isinstance(sensor, FunctionSensor):
        raise ValueError(f"sensor must be a LinearSensor or a FunctionSensor, got {type(sensor).__name__}")
    return SensedModel(*moved(model, interval), sensor, model.motion, interval)


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Check what a caller's function returned."""
    array = as_numbers(f"what the sensor's {name} returns", values)
    if array.shape != shape:
        raise ValueError(f"sensor {name} must return shape {shape}, got {array.shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"sensor {name} must return finite values, got NaN or infinity; guard it near its singularity")
    check_within(f"what the sensor's {name} returns", array, _LARGEST, "guard it near its singularity")
    return array


@njit(cache=True, nogil=True)
def _sigma_points(mean, covariance, n):  # type: ignore[no-untyped-def]
    """Sigma points (k, 2 n + 1, n) of the x blocks, and the columns of the scaled roots (k, n, n)."""
    count = mean.shape[0]
    spread = math.sqrt(n + max(3.0 - n, 0.0))
    points = np.empty((count, 2 * n + 1, n))
    roots = np.zeros((count, n, n))
    for i in range(count):
        root = roots[i]
        for r in range(n):
            for c in range(r + 1):
                value = covariance[i, r, c]
                for k in range(c):
                    value -= root[r, k] * root[c, k]
                if r == c:
                    # A state entry that is known exactly has no spread.
                    root[r, r] = math.sqrt(max(value, 0.0))
                elif root[c, c] > 0.0:
                    root[r, c] = value / root[c, c]
        for k in range(n):
            points[i, 0, k] = mean[i, k]
            for p in range(n):
                points[i, 1 + p, k] = mean[i, k] + spread * root[k, p]
                points[i, 1 + n + p, k] = mean[i, k] - spread * root[k, p]
    return points, roots


@njit(cache=True, nogil=True)
def _join(n, y, roots, noise, angular, mean, covariance):  # type: ignore[no-untyped-def]
    """Fill the y blocks from the measurements (k, 2 n + 1, m) of the sigma points.

    Angles are averaged as differences from that of the mean point, so that the wrap at +-pi has no effect.
    """
    count, points, m = y.shape
    kappa = max(3.0 - n, 0.0)
    spread, side, first = math.sqrt(n + kappa), 0.5 / (n + kappa), kappa / (n + kappa)
    turn = 2.0 * math.pi
    average = np.empty(m)
    for i in range(count):
        for r in range(m):
            center = y[i, 0, r]
            average[r] = 0.0
            for p in range(points):
                difference = y[i, p, r] - center
                if angular[r]:
                    difference -= turn * math.floor(difference / turn + 0.5)
                y[i, p, r] = difference
                average[r] += (first if p == 0 else side) * difference
            value = center + average[r]
            mean[i, n + r] = value - turn * math.floor(value / turn + 0.5) if angular[r] else value
        for r in range(m):
            for c in range(r + 1):
                value = noise[r, c]
                for p in range(points):
                    share = first if p == 0 else side
                    value += share * (y[i, p, r] - average[r]) * (y[i, p, c] - average[c])
                covariance[i, n + r, n + c] = value
                covariance[i, n + c, n + r] = value
            for k in range(n):
                value = 0.0
                for p in range(n):
                    value += side * spread * roots[i, k, p] * (y[i, 1 + p, r] - y[i, 1 + n + p, r])
                covariance[i, n + r, k] = value
                covariance[i, k, n + r] = value
