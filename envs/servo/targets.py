"""Motions of the target over the plane: positions and velocities at the sample instants of an episode."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.servo.levels import ServoConfig
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

PERIOD = 0.05
"""Control and sampling period (Zhang 2011, section 3.2), s."""
JOINT_LOW = np.array([-math.pi / 2, 0.0])
"""Lower joint stops (Zhang 2011, section 3.1), rad."""
JOINT_HIGH = np.array([math.pi / 2, math.pi])
"""Upper joint stops, rad."""
LEAD = 6
"""Number of samples before the reset in an episode's tables, for frames taken before the reset."""
START = np.array([0.0, math.pi / 2])
"""Joint angles at reset, rad."""

JOINT_MARGIN = 0.05
"""Least distance of a solvable path from the joint stops, rad."""
RATE_FRACTION = 0.8
"""Largest share of the joint rate limit that a solvable path may need."""
SINGULAR_SINE = 0.1
"""Least sine of the angle between link 1 and the direction to the target on a solvable path."""


@njit(cache=True, nogil=True)
def solvable(path, l1, l2, max_joint_rate):  # type: ignore[no-untyped-def]
    """Return True if the arm can stay above every sample of a path with a margin.

    The closed-form inverse kinematics must keep `JOINT_MARGIN` from the stops, need at most `RATE_FRACTION` of the
    joint rate limit, and keep `SINGULAR_SINE` away from the eye-in-hand singularity (the target on the line of link 1).

    Args:
        path: Positions at sample instants, shape (samples, >= 2), m.
        l1: Length of the first link, m.
        l2: Length of the second link, m.
        max_joint_rate: Limit of the joint rates, rad/s.
    """
    limit = RATE_FRACTION * max_joint_rate * PERIOD
    before1, before2 = 0.0, 0.0
    for k in range(path.shape[0]):
        x, y = path[k, 0], path[k, 1]
        r2 = x * x + y * y
        cosine = (r2 - l1 * l1 - l2 * l2) / (2.0 * l1 * l2)
        if not -1.0 < cosine < 1.0:
            return False
        theta2 = math.acos(cosine)
        theta1 = math.atan2(y, x) - math.atan2(l2 * math.sin(theta2), l1 + l2 * cosine)
        if theta2 < JOINT_MARGIN or theta2 > math.pi - JOINT_MARGIN or abs(theta1) > math.pi / 2 - JOINT_MARGIN:
            return False
        if l2 * math.sin(theta2) < SINGULAR_SINE * math.sqrt(r2):
            return False
        if k > 0 and (abs(theta1 - before1) > limit or abs(theta2 - before2) > limit):
            return False
        before1, before2 = theta1, theta2
    return True


def reachable_point(rng: np.random.Generator, links: Array) -> Array:
    """Draw a point that the arm reaches well inside its joint range."""
    return np.array(reachable_place(rng.random(), rng.random(), links[0], links[1]))


@njit(cache=True, nogil=True)
def reachable_place(share1, share2, l1, l2):  # type: ignore[no-untyped-def]
    """Map two uniform numbers in [0, 1] to a point that the arm reaches well inside its joint range."""
    theta1, theta2 = -1.3 + 2.6 * share1, 0.4 + 2.0 * share2
    return (
        l1 * math.cos(theta1) + l2 * math.cos(theta1 + theta2),
        l1 * math.sin(theta1) + l2 * math.sin(theta1 + theta2),
    )


def draw_waypoints(config: ServoConfig, rng: np.random.Generator, links: Array, times: Array) -> Array:
    """Draw a path of straight runs at constant speed between random points. The arm can follow each run.

    Args:
        config: Parameters of the world.
        rng: Random stream of the target.
        links: Link lengths, shape (2,), m.
        times: Sample times, shape (samples,), s. With a warm-up, the target rests before time 0.

    Returns:
        Positions and velocities, shape (samples, 4): m, m, m/s, m/s.
    """
    resting = times < 0 if config.warmup > 0 else np.zeros(len(times), dtype=bool)
    clock = np.where(resting, 0.0, times)
    points, instants = [reachable_point(rng, links)], [0.0]
    while instants[-1] < clock[-1]:
        here = points[-1]
        there, speed = here, 1.0
        for _ in range(50):
            candidate, speed = reachable_point(rng, links), rng.uniform(0.1, 0.35) * links.sum()
            samples = max(3, int(np.hypot(*(candidate - here)) / (speed * PERIOD)))
            if solvable(np.linspace(here, candidate, samples), links[0], links[1], config.max_joint_rate):
                there = candidate
                break
        length = float(np.hypot(*(there - here)))
        points.append(there)
        instants.append(instants[-1] + (length / speed if length > 0 else 1.0))
    corners, at = np.array(points), np.array(instants)
    velocities = np.diff(corners, axis=0) / np.diff(at)[:, None]
    run = np.clip(np.searchsorted(at, clock, side="right") - 1, 0, len(velocities) - 1)
    since = np.maximum(clock, 0.0) - at[run]
    path = np.empty((len(clock), 4))
    path[:, 2:] = np.where(clock[:, None] < 0, 0.0, velocities[run])
    path[:, :2] = corners[run] + velocities[run] * since[:, None]
    path[resting, 2:] = 0.0
    return path
