"""Limits of joint angles and accelerations, as bounds of the joint rates of one period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        below = np.minimum(np.asarray(self.low) + self.margin - joint_angles, 0.0)
        return below, np.maximum(np.asarray(self.high) - self.margin - joint_angles, 0.0)

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
        room_below = joint_angles - (np.asarray(self.low) + self.margin)
        room_above = (np.asarray(self.high) - self.margin) - joint_angles
        low = -np.minimum(max_joint_rate, self._fastest(room_below, period))
        high = np.minimum(max_joint_rate, self._fastest(room_above, period))
        if self.max_acceleration is not None:
            change = self.max_acceleration * period
            # Where a joint must stop sooner than the acceleration allows, it brakes as hard as it may.
            low = np.clip(np.maximum(low, joint_rate - change), -np.inf, joint_rate + change)
            high = np.clip(np.minimum(high, joint_rate + change), joint_rate - change, np.inf)
        return np.minimum(low, high), np.maximum(low, high)

    def _fastest(self, room: Array, period: float) -> Array:
        """Largest rate towards a limit at a distance of `room` that leaves enough room to brake."""
        room = np.maximum(room, 0.0)
        fastest = room / period
        if self.max_acceleration is None:
            return fastest
        # The rate v is held for one period, then falls by a * period in each: v * period + v^2 / (2 a) <= room.
        brake = self.max_acceleration * period
        return np.minimum(fastest, np.sqrt(brake**2 + 2.0 * self.max_acceleration * room) - brake)
