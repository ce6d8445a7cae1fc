"""Planar two-link arms: masses, the pose at rest, and the interface of the engines that move them.

Each arm has two rods, the camera's 0.2 kg added to the second one, and pivots, joint stops and motors between them.
There is no gravity. Two engines solve for its motion: pymunk (`pymunk_arms`), the reference, and compiled code
(`compiled_arms`) with the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from servotrack.envs.servo.targets import START
from servotrack.envs.state import State
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels

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


LOWER_MASS = LINK_MASS + CAMERA_MASS
"""Mass of the second rod with the camera at its far end, kg."""
SQUARE = 2.0
"""Exponent of squares, see `rods_at_rest`."""


@njit(cache=True, nogil=True)
def lower_center(l2):  # type: ignore[no-untyped-def]
    """Distance from the elbow to the center of gravity of a second rod of length l2, m."""
    return (LINK_MASS * l2 / 2 + CAMERA_MASS * l2) / LOWER_MASS


@njit(cache=True, nogil=True)
def rods_at_rest(l1, l2, two):  # type: ignore[no-untyped-def]
    """Return the `Rods` of an arm at the start pose.

    Args:
        l1: Length of the first link, m.
        l2: Length of the second link, m.
        two: Exponent of squares, `SQUARE`. It is an argument because compiled code multiplies where it is a constant,
            and a product rounds otherwise than the power of Python floats now and then.
    """
    center = lower_center(l2)
    from_middle, from_camera = math.pow(center - l2 / 2, two), math.pow(l2 - center, two)
    moment = LINK_MASS * (l2 * l2 / 12 + from_middle) + CAMERA_MASS * from_camera
    theta1, theta2 = START[0], START[0] + START[1]
    c1, s1, c2, s2 = math.cos(theta1), math.sin(theta1), math.cos(theta2), math.sin(theta2)
    return Rods(
        (LINK_MASS, LOWER_MASS),
        (LINK_MASS * l1 * l1 / 12, moment),
        l1 / 2,
        center,
        (theta1, theta2),
        ((l1 / 2 * c1, l1 / 2 * s1), (l1 * c1 + center * c2, l1 * s1 + center * s2)),
    )


class Arms(Protocol):
    """N arms, driven by joint rates, one control period per step.

    Attributes:
        angles: True joint angles, shape (N, 2), rad; updated by every `step`, never replaced.
    """

    angles: Array

    def reset(self, rows: Labels, links: Array) -> None:
        """Restart the arms of rows (n,) with links (n, 2) m at the start pose. The other arms are not changed."""

    def step(self, rates: Array) -> None:
        """Drive all joints at `rates` (N, 2) rad/s for one control period and read the angles."""

    def tool_gap(self) -> float:
        """Largest gap between two ends that a pivot holds together, m: the solver's error."""

    def get_state(self) -> State:
        """Return what `set_state` needs besides the links."""

    def check_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raise a ValueError for a state that `set_state` cannot use."""

    def set_state(self, state: Mapping[str, NDArray[Any]], links: Array) -> None:
        """Bring all arms into a state that `get_state` returned, with links (N, 2) m."""
