"""Motion of one target over any interval: transition matrix and process noise as functions of time.

Each model is a white noise that drives a linear system in continuous time, integrated exactly over the interval
(Bar-Shalom, Li and Kirubarajan 2001, sections 6.2 and 11.7). So two steps of one second are the same as one step of
two, and scans may come whenever they come.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servotrack.estimators.types import Array


class Motion(Protocol):
    """Motion of one target over an interval; any function of the interval will do."""

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition F (n, n) and covariance Q (n, n) of its noise over `dt` seconds, dt > 0."""


@dataclass(frozen=True)
class AxisMotion(ABC):
    """A motion that is the same along each axis and independent between them."""

    process_noise: float
    dimensions: int = 2

    def __post_init__(self) -> None:
        _check_axes(self.process_noise, self.dimensions)

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition and process noise over `dt` seconds. Shapes (k d, k d) for d axes of k state entries."""
        F, Q = self._axis(dt)
        return _per_axis(F, self.dimensions), _per_axis(self.process_noise**2 * Q, self.dimensions)

    @abstractmethod
    def _axis(self, t: float) -> tuple[Array, Array]:
        """Transition of one axis, and its noise for a density of one. Shapes (k, k)."""


@dataclass(frozen=True)
class ConstantVelocity(AxisMotion):
    """Nearly constant velocity along each axis; the state is [x, vx, y, vy, ...].

    Args:
        process_noise: Square root of the spectral density of the acceleration, m/s^1.5. Raising it follows maneuvers
            sooner and filters less.
        dimensions: Number of axes.

    Raises:
        ValueError: An argument is out of range.
    """

    def _axis(self, t: float) -> tuple[Array, Array]:
        cross = t**2 / 2.0
        return np.array([[1.0, t], [0.0, 1.0]]), np.array([[t**3 / 3.0, cross], [cross, t]])


@dataclass(frozen=True)
class ConstantAcceleration(AxisMotion):
    """Nearly constant acceleration along each axis; the state is [x, vx, ax, y, vy, ay, ...].

    Args:
        process_noise: Square root of the spectral density of the jerk, m/s^2.5. Raising it follows maneuvers sooner.
        dimensions: Number of axes.

    Raises:
        ValueError: An argument is out of range.
    """

    def _axis(self, t: float) -> tuple[Array, Array]:
        F = np.array([[1.0, t, t**2 / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        Q = np.array(
            [
                [t**5 / 20.0, t**4 / 8.0, t**3 / 6.0],
                [t**4 / 8.0, t**3 / 3.0, t**2 / 2.0],
                [t**3 / 6.0, t**2 / 2.0, t],
            ]
        )
        return F, Q


@dataclass(frozen=True)
class WhiteAcceleration(AxisMotion):
    """`ConstantVelocity` with the state of `ConstantAcceleration`, to stand beside it among motion modes.

    The acceleration of the state has no influence on the motion; it is drawn anew at every scan, with the variance of
    the mean acceleration between two scans.

    Args:
        process_noise: Square root of the spectral density of the acceleration, m/s^1.5.
        dimensions: Number of axes.

    Raises:
        ValueError: An argument is out of range.
    """

    def _axis(self, t: float) -> tuple[Array, Array]:
        F = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
        Q = np.array([[t**3 / 3.0, t**2 / 2.0, 0.0], [t**2 / 2.0, t, 0.0], [0.0, 0.0, 1.0 / t]])
        return F, Q


@dataclass(frozen=True)
class Agile:
    """A motion with more process noise.

    Args:
        motion: The motion.
        factor: Factor on the standard deviation of its noise.
    """

    motion: Motion
    factor: float

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition and process noise over `dt` seconds."""
        F, Q = self.motion(dt)
        return F, self.factor**2 * Q


@dataclass(frozen=True)
class Turning:
    """A motion of the state [x, vx, y, vy] whose transition is a turn; its noise stays.

    Args:
        motion: The motion.
        turn_rate: Rate of the turn, rad/s, positive counterclockwise.
    """

    motion: Motion
    turn_rate: float

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition and process noise over `dt` seconds."""
        return turn(self.turn_rate, dt), self.motion(dt)[1]


@dataclass(frozen=True)
class CoordinatedTurn:
    """Motion in the plane at a known turn rate; the state is [x, vx, y, vy].

    Args:
        process_noise: Square root of the spectral density of the acceleration, m/s^1.5.
        turn_rate: Rate at which the velocity turns, counterclockwise from x to y, rad/s; 0 is `ConstantVelocity`.

    Raises:
        ValueError: An argument is out of range.
    """

    process_noise: float
    turn_rate: float

    def __post_init__(self) -> None:
        _check_axes(self.process_noise, 2)
        if not math.isfinite(self.turn_rate):
            raise ValueError(f"turn_rate must be finite, got {self.turn_rate!r}")

    def __call__(self, dt: float, /) -> tuple[Array, Array]:
        """Transition and process noise over `dt` seconds. Shapes (4, 4)."""
        return turn(self.turn_rate, dt), self.process_noise**2 * _turning_noise(self.turn_rate, dt)


def turn(rate: float, dt: float) -> Array:
    """Transition of [x, vx, y, vy] in a turn at `rate` rad/s over `dt` seconds. Shape (4, 4)."""
    angle = rate * dt
    # sin(a)/w and (1 - cos(a))/w without a difference of nearly equal numbers at a small rate.
    along = dt * _sinc(angle)
    across = dt * _sinc(0.5 * angle) * math.sin(0.5 * angle)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, along, 0.0, -across], [0.0, c, 0.0, -s], [0.0, across, 1.0, along], [0.0, s, 0.0, c]])


def _turning_noise(rate: float, dt: float) -> Array:
    """Integral of F(s) G G^T F(s)^T over s from 0 to dt for white noise of unit density on both velocities."""
    angle = rate * dt
    lag = _lag_of_sine(angle)
    position, turned = 2.0 * dt**3 * lag, dt**2 * angle * lag
    mixed = 0.5 * (dt * _sinc(0.5 * angle)) ** 2
    return np.array(
        [
            [position, mixed, 0.0, turned],
            [mixed, dt, -turned, 0.0],
            [0.0, -turned, position, mixed],
            [turned, 0.0, mixed, dt],
        ]
    )


def _sinc(angle: float) -> float:
    """Compute sin(a) / a. NumPy's own has other last bits in other versions."""
    return math.sin(angle) / angle if angle != 0.0 else 1.0


def _lag_of_sine(angle: float) -> float:
    """Compute (a - sin a) / a^3, below .1 rad by its series, since the difference would lose its digits."""
    if abs(angle) > 0.1:
        return (angle - math.sin(angle)) / angle**3
    square = angle**2
    rest = 1.0 / 5040.0 - square * (1.0 / 362880.0 - square / 39916800.0)
    return 1.0 / 6.0 - square * (1.0 / 120.0 - square * rest)


def _per_axis(block: Array, dimensions: int) -> Array:
    """The matrix of all axes from that of one."""
    size = len(block)
    matrix = np.zeros((dimensions, size, dimensions, size))
    for axis in range(dimensions):
        matrix[axis, :, axis] = block
    return matrix.reshape(dimensions * size, dimensions * size)


def _check_axes(process_noise: float, dimensions: int) -> None:
    if not (math.isfinite(process_noise) and process_noise > 0.0):
        raise ValueError(f"process_noise must be finite and > 0, got {process_noise!r}")
    if dimensions < 1:
        raise ValueError(f"dimensions must be >= 1, got {dimensions!r}")
