"""Limits of joint angles and accelerations, as bounds of the joint rates of one period."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array
from servotrack.estimators.validation import first_bad


@dataclass(frozen=True)
class JointLimits:
    """Limits that the joints keep: their rates are bounded so that they can stop in time.

    Args:
        low: Lower limit of each joint. Shape (n,), rad.
        high: Upper limit of each joint. Shape (n,), rad.
        margin: Distance from the limits that is kept, rad. Raise it for joints whose encoders have homing errors.
        max_acceleration: Limit of each joint's acceleration, rad/s^2; None: no limit.
        tolerance: Distance outside the limits from which joint angles are refused, rad. Nearer ones only move inward.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    margin: float = 0.0
    max_acceleration: float | None = None
    tolerance: float = 0.2

    _inner: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)
        if low.ndim != 1 or low.shape != high.shape or not np.isfinite([low, high]).all():
            raise ValueError(
                f"low and high must be finite and have one entry per joint, got {self.low} and {self.high}"
            )
        for name in ("margin", "tolerance"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0 rad, got {getattr(self, name)}")
        narrow = low + 2.0 * self.margin >= high
        if narrow.any():
            raise ValueError(
                f"low must be below high by more than twice the margin of {self.margin:g} rad, got "
                f"{first_bad(low, narrow)} and {first_bad(high, narrow)}"
            )
        if self.max_acceleration is not None and not 0.0 < self.max_acceleration < np.inf:
            raise ValueError(f"max_acceleration must be finite and > 0 rad/s^2, or None, got {self.max_acceleration}")
        object.__setattr__(self, "_inner", (low + self.margin, high - self.margin))

    def check(self, joint_angles: Array) -> None:
        """Raise ValueError if joint angles (*batch, n) are farther outside the limits than the tolerance."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        if joint_angles.shape[-1:] != low.shape:
            raise ValueError(
                f"limits must have one entry per joint, got {len(low)} for joint_angles of shape {joint_angles.shape}"
            )
        outside = (joint_angles < low - self.tolerance) | (joint_angles > high + self.tolerance)
        if outside.any():
            joint = int(np.argwhere(outside)[0][-1])
            raise ValueError(
                f"joint_angles must lie within the limits, got {first_bad(joint_angles, outside)} where joint {joint} "
                f"has [{low[joint]:g}, {high[joint]:g}] rad; check unit, sign and zero of the encoder"
            )

    def room(self, joint_angles: Array) -> tuple[Array, Array]:
        """Motions to the lower and upper limits, margin excluded; they include 0. Shapes (*batch, n), rad."""
        low, high = self._inner
        return np.minimum(low - joint_angles, 0.0), np.maximum(high - joint_angles, 0.0)

    def bounds(
        self, joint_angles: Array, joint_rate: Array, max_joint_rate: float, period: float
    ) -> tuple[Array, Array]:
        """Bounds of the joint rates of the next period.

        Args:
            joint_angles: Present angles. Shape (*batch, n), rad.
            joint_rate: Rates of the last period. Shape (*batch, n), rad/s.
            max_joint_rate: Limit of each joint rate, rad/s.
            period: Control period, s.

        Returns:
            Least and largest rates; they hold 0 or lead inward where a joint is at or outside its limit. Shapes
            (*batch, n), rad/s.
        """
        shape = joint_angles.shape
        low, high = _bounds(
            np.ascontiguousarray(joint_angles).reshape(-1, shape[-1]),
            np.ascontiguousarray(joint_rate).reshape(-1, shape[-1]),
            self._inner,
            max_joint_rate,
            # No limit: a negative number.
            -1.0 if self.max_acceleration is None else self.max_acceleration,
            period,
        )
        return low.reshape(shape), high.reshape(shape)


@njit(cache=True, nogil=True)
def _bounds(angles, rates, inner, fastest, acceleration, period):  # type: ignore[no-untyped-def]
    """`JointLimits.bounds` over rows; a negative acceleration is none."""
    rows, n = angles.shape
    least, most = np.empty((rows, n)), np.empty((rows, n))
    brake = acceleration * period
    for row in range(rows):
        for j in range(n):
            low = -min(fastest, _fastest(angles[row, j] - inner[0][j], acceleration, period))
            high = min(fastest, _fastest(inner[1][j] - angles[row, j], acceleration, period))
            if acceleration > 0.0:
                # Where a joint must stop sooner than the acceleration allows, it brakes as hard as it may.
                slower, faster = rates[row, j] - brake, rates[row, j] + brake
                low = min(max(low, slower), faster)
                high = max(min(high, faster), slower)
            least[row, j], most[row, j] = min(low, high), max(low, high)
    return least, most


@njit(cache=True, nogil=True)
def _fastest(room, acceleration, period):  # type: ignore[no-untyped-def]
    """Largest rate towards a limit at a distance of `room` that leaves enough room to brake."""
    room = max(room, 0.0)
    if acceleration <= 0.0:
        return room / period
    # The rate v is held for one period, then falls by a * period in each: v * period + v^2 / (2 a) <= room.
    brake = acceleration * period
    return min(room / period, math.sqrt(brake * brake + 2.0 * acceleration * room) - brake)
