"""Social force model of pedestrians as a compiled kernel: desired velocities and repulsion.

Helbing and Molnar, "Social force model for pedestrian dynamics", Physical Review E 51(5), 1995; equation numbers below
refer to it. Contacts between bodies are handled elsewhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels, Mask

X, Z, PAUSE, UNTIL, DUE, FACE = range(6)
"""Columns of a leg: goal (m), minimum stay (frames), frame until which to stay, frame of arrival (below 0: at the
person's own pace), and heading during the stay (rad; NaN: unchanged)."""
LEG_NUMBERS = 6
"""Number of columns of a leg."""

_RELAXATION = 0.5
"""tau of eq. (2), s."""
_STRENGTH, _RANGE, _STEP_TIME = 2.1, 0.3, 2.0
"""V0 (m^2/s^2), sigma (m) and the look-ahead (s) of eqs. (3) and (4)."""
_WALL_STRENGTH, _WALL_RANGE = 10.0, 0.2
"""U0 (m^2/s^2) and R (m) of eq. (5)."""
_OBSTACLE_STRENGTH, _OBSTACLE_RANGE = 2.5, 0.25
"""Strength (m/s^2) and range (m) of the repulsion by obstacles; the range is larger than that of walls."""
_OUT_OF_SIGHT_WEIGHT, _SIGHT_COSINE = 0.5, math.cos(math.radians(100.0))
"""Weight of people outside the field of view, and cosine of its half angle, eqs. (7) and (8)."""
_MAX_SPEED_RATIO = 1.3
"""Maximum speed relative to the desired speed, eq. (10)."""
_REPULSION_TURN = math.radians(12.0)
"""Rotation of the repulsion, rad, so that two people who meet head-on do not stop each other."""
_PARTY_WEIGHT = 0.12
"""Weight of people of the same party."""
_STANDING_WEIGHT = 0.25
"""Weight of the forces of others on a standing person."""
_STOP_DISTANCE = 0.2
"""Distance from a goal at which a person stops, m."""
_TIMED_STOP_DISTANCE = 0.05
"""Distance from a goal with an arrival time at which a person stops, m."""
_PASSING_DISTANCE = 0.4
"""Distance from a goal without a stay at which the next leg begins, m."""
_MIN_TIMED_SPEED, _MAX_TIMED_SPEED = 0.2, 1.9
"""Range of the speed of a person with an arrival time, m/s."""
_LEG_TIMEOUT = 40.0
"""Time after which a leg is aborted, s."""


class Plans(NamedTuple):
    """Plans of n people, constant during a simulation.

    Attributes:
        legs: Legs of each person, with the columns above, shape (n, max legs, LEG_NUMBERS).
        leg_count: Number of legs, shape (n,).
        pace: Desired speed, shape (n,), m/s.
        wander: Amplitude (rad), rate (rad per frame) and phase (rad) of small changes of direction, shape (n, 3).
        party: Index of the party, shape (n,).
    """

    legs: Array
    leg_count: Labels
    pace: Array
    wander: Array
    party: Labels


class Progress(NamedTuple):
    """Progress of n people in their plans, changed in place by `drive`.

    Attributes:
        leg: Index of the current leg, shape (n,). It is `leg_count` when all legs are finished.
        since: Frame at which the current leg began, shape (n,).
        arrived: Frame of arrival at the end of the current leg, -1 before, shape (n,).
        facing: Heading of standing people, shape (n,), rad; NaN while walking and if unspecified.
        over: True for people who have finished all legs, shape (n,), bool.
    """

    leg: Labels
    since: Labels
    arrived: Labels
    facing: Array
    over: Mask


@njit(cache=True, nogil=True)
def drive(active, position, velocity, plans, progress, walls, obstacles, frame, dt):  # type: ignore[no-untyped-def]
    """Update the velocities of all active people, and advance finished legs.

    Args:
        active: Indices of the people in the scene, shape (a,).
        position: Positions, shape (n, 2), m.
        velocity: Velocities, shape (n, 2), m/s; replaced by the new ones.
        plans: Plans of all people, `Plans`.
        progress: Progress of all people in their plans, `Progress`; changed in place.
        walls: z of the back wall and of the front border, m.
        obstacles: x, z and radius of each obstacle, shape (o, 3), m.
        frame: Number of the frame.
        dt: Time between frames, s.

    Returns:
        True if any person has finished all legs.
    """
    legs, leg_count, pace, wander, party = plans.legs, plans.leg_count, plans.pace, plans.wander, plans.party
    leg, since, arrived = progress.leg, progress.since, progress.arrived
    facing, over = progress.facing, progress.over
    count = len(active)
    any_over = False
    wanted = np.zeros((count, 2))
    speeds = np.zeros(count)
    for a in range(count):
        i = active[a]
        distance, dx, dz = 0.0, 0.0, 0.0
        while leg[i] < leg_count[i]:
            goal = legs[i, leg[i]]
            dx, dz = goal[X] - position[i, 0], goal[Z] - position[i, 1]
            distance = math.sqrt(dx * dx + dz * dz)
            near = _STOP_DISTANCE if goal[PAUSE] > 0.0 or goal[UNTIL] > frame else _PASSING_DISTANCE
            if goal[DUE] >= 0.0:
                near = _TIMED_STOP_DISTANCE
            if arrived[i] < 0 and (distance < near or (frame - since[i]) * dt > _LEG_TIMEOUT):
                arrived[i] = frame
            if arrived[i] < 0 or frame - arrived[i] < goal[PAUSE] or frame < goal[UNTIL]:
                break
            leg[i] += 1
            since[i] = frame
            arrived[i] = -1
        facing[i] = math.nan
        if leg[i] >= leg_count[i]:
            over[i] = any_over = True
            continue
        goal = legs[i, leg[i]]
        if arrived[i] >= 0:
            facing[i] = goal[FACE]
            # People who were pushed away return slowly.
            back = 0.0 if distance < 0.5 * _STOP_DISTANCE else 0.4
            wanted[a, 0], wanted[a, 1] = back * dx, back * dz
            speeds[a] = 0.3
            continue
        speed = pace[i]
        if goal[DUE] >= 0.0:
            speed = min(max(distance / (max(goal[DUE] - frame, 1.0) * dt), _MIN_TIMED_SPEED), _MAX_TIMED_SPEED)
        elif goal[PAUSE] > 0.0:
            speed *= min(1.0, 0.35 + distance)
        angle = wander[i, 0] * math.sin(wander[i, 1] * frame + wander[i, 2]) * min(1.0, 0.5 * distance)
        c, s = math.cos(angle), math.sin(angle)
        wanted[a, 0] = speed * (c * dx - s * dz) / distance
        wanted[a, 1] = speed * (s * dx + c * dz) / distance
        speeds[a] = speed
    force = np.zeros((count, 2))
    turn_c, turn_s = math.cos(_REPULSION_TURN), math.sin(_REPULSION_TURN)
    for a in range(count):
        i = active[a]
        weight = 1.0 if math.sqrt(wanted[a, 0] ** 2 + wanted[a, 1] ** 2) > 0.15 else _STANDING_WEIGHT
        fx, fz = 0.0, 0.0
        for b in range(count):
            if a == b:
                continue
            j = active[b]
            rx, rz = position[i, 0] - position[j, 0], position[i, 1] - position[j, 1]
            r = math.sqrt(rx * rx + rz * rz)
            if r > 4.0 or r < 1e-9:
                continue
            sx, sz = velocity[j, 0] * _STEP_TIME, velocity[j, 1] * _STEP_TIME
            step = math.sqrt(sx * sx + sz * sz)
            qx, qz = rx - sx, rz - sz
            q = max(math.sqrt(qx * qx + qz * qz), 1e-9)
            # Half the minor axis of the ellipse of eq. (4); its gradient gives the force of eq. (3).
            axis = 0.5 * math.sqrt(max((r + q) ** 2 - step * step, 1e-6))
            size = _STRENGTH / _RANGE * math.exp(-axis / _RANGE) * (r + q) / (4.0 * axis)
            gx, gz = size * (rx / r + qx / q), size * (rz / r + qz / q)
            if wanted[a, 0] * -gx + wanted[a, 1] * -gz < _SIGHT_COSINE * speeds[a] * math.sqrt(gx * gx + gz * gz):
                gx, gz = _OUT_OF_SIGHT_WEIGHT * gx, _OUT_OF_SIGHT_WEIGHT * gz
            if party[i] == party[j]:
                gx, gz = _PARTY_WEIGHT * gx, _PARTY_WEIGHT * gz
            fx += turn_c * gx + turn_s * gz
            fz += -turn_s * gx + turn_c * gz
        for o in range(len(obstacles)):
            rx, rz = position[i, 0] - obstacles[o, 0], position[i, 1] - obstacles[o, 1]
            r = max(math.sqrt(rx * rx + rz * rz), 1e-9)
            size = _OBSTACLE_STRENGTH * math.exp(-max(r - obstacles[o, 2], 0.0) / _OBSTACLE_RANGE) / r
            # Sideways, toward the side on which the person passes.
            side = 1.0 if rz * wanted[a, 0] > rx * wanted[a, 1] else -1.0
            fx += size * (rx + side * rz)
            fz += size * (rz - side * rx)
        behind = max(walls[0] - position[i, 1], 0.0)
        before = max(position[i, 1] - walls[1], 0.0)
        wall = _WALL_STRENGTH / _WALL_RANGE * (math.exp(-before / _WALL_RANGE) - math.exp(-behind / _WALL_RANGE))
        force[a, 0], force[a, 1] = weight * fx, weight * fz + wall
    for a in range(count):
        i = active[a]
        vx = velocity[i, 0] + dt * ((wanted[a, 0] - velocity[i, 0]) / _RELAXATION + force[a, 0])
        vz = velocity[i, 1] + dt * ((wanted[a, 1] - velocity[i, 1]) / _RELAXATION + force[a, 1])
        speed = math.sqrt(vx * vx + vz * vz)
        most = _MAX_SPEED_RATIO * max(speeds[a], 0.1)
        if speed > most:
            vx, vz = vx * most / speed, vz * most / speed
        velocity[i, 0], velocity[i, 1] = vx, vz
    return any_over
