"""Planar two-link arms: masses, the pose at rest, and the interface of the engines that move them.

Each arm has two rods, the camera's 0.2 kg added to the second one, and pivots, joint stops and motors between them.
There is no gravity. Two engines solve for its motion: pymunk (`pymunk_arms`), the reference, and compiled code
(`compiled_arms`) with the same bits.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from servotrack.envs.servo.targets import START
from servotrack.estimators.types import Array

LINK_MASS = 1.0
"""Mass of each link, kg."""
CAMERA_MASS = 0.2
"""Mass of the camera, kg."""
PIVOT_BIAS = 0.01**60
"""Share of a pivot's position error that remains after one second (pymunk's `error_bias`)."""


class Rods(NamedTuple):
    """Masses and start pose of an arm's two rods.

    Attributes:
        masses: Mass of each rod, kg.
        moments: Moment of inertia of each rod about its center of gravity, kg m^2.
        half: Distance from the first rod's center of gravity to either end, m.
        center: Distance from the elbow to the second rod's center of gravity, m.
        angles: Angle of each rod in the plane at the start, rad.
        positions: Centers of gravity at the start, m.
    """

    masses: tuple[float, float]
    moments: tuple[float, float]
    half: float
    center: float
    angles: tuple[float, float]
    positions: tuple[tuple[float, float], tuple[float, float]]


def rods_at_rest(links: Array) -> Rods:
    """Return the rods of an arm with links (2,) m at the start pose."""
    l1, l2 = float(links[0]), float(links[1])
    # The camera sits at the far end of link 2: center of gravity and moment of inertia move with it.
    mass = LINK_MASS + CAMERA_MASS
    center = (LINK_MASS * l2 / 2 + CAMERA_MASS * l2) / mass
    # Interpreted, not compiled: the two round powers differently, and all engines must start from the same bits.
    moment = LINK_MASS * (l2 * l2 / 12 + (center - l2 / 2) ** 2) + CAMERA_MASS * (l2 - center) ** 2
    theta1, theta2 = float(START[0]), float(START[1])
    c1, s1, c2, s2 = np.cos(theta1), np.sin(theta1), np.cos(theta1 + theta2), np.sin(theta1 + theta2)
    return Rods(
        masses=(LINK_MASS, mass),
        moments=(LINK_MASS * l1 * l1 / 12, moment),
        half=l1 / 2,
        center=center,
        angles=(theta1, theta1 + theta2),
        positions=((l1 / 2 * c1, l1 / 2 * s1), (l1 * c1 + center * c2, l1 * s1 + center * s2)),
    )


class Arms(Protocol):
    """N arms, driven by joint rates, one control period per step.

    Attributes:
        angles: True joint angles, shape (N, 2), rad; updated by every `step`, never replaced.
    """

    angles: Array

    def reset(self, row: int, links: Array) -> None:
        """Restart one arm with links (2,) m at the start pose. The other arms are not changed."""

    def step(self, rates: Array) -> None:
        """Drive all joints at `rates` (N, 2) rad/s for one control period and read the angles."""

    def tool_gap(self) -> float:
        """Largest gap between two ends that a pivot holds together, m: the solver's error."""
