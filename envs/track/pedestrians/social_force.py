"""Where people want to go and how they keep off each other: the social force model as a compiled kernel.

Helbing and Molnar, "Social force model for pedestrian dynamics", Physical Review E 51(5), 1995; equation numbers below
are theirs. What bodies do that touch is not its business.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

X, Z, PAUSE, UNTIL, DUE, FACE = range(6)
"""Columns of a leg: where to (m), how many frames to stay at least, the frame before which not to go on, the frame at
which to arrive (below 0: at one's own pace), and where to face meanwhile (rad; NaN: as before)."""
LEG_NUMBERS = 6

_RELAXATION = 0.5
"""tau of eq. (2), s."""
_STRENGTH, _RANGE, _STEP_TIME = 2.1, 0.3, 2.0
"""V0 (m^2/s^2), sigma (m) and the look-ahead (s) of eqs. (3) and (4)."""
_WALL_STRENGTH, _WALL_RANGE = 10.0, 0.2
"""U0 (m^2/s^2) and R (m) of eq. (5)."""
_OBSTACLE_STRENGTH, _OBSTACLE_RANGE = 2.5, 0.25
"""The same for things that stand about; wider, so that people do not brush against them."""
_BEHIND, _SEEN_COSINE = 0.5, math.cos(math.radians(100.0))
"""What a person out of sight counts, and where sight ends, eqs. (7) and (8)."""
_FASTEST = 1.3
"""Largest speed in desired ones, eq. (10)."""
_KEEP_RIGHT = math.radians(12.0)
"""Repulsion is turned by this, so that two who meet head on do not stop each other."""
_FAMILIAR = 0.12
"""What a person of the same party counts."""
_STANDING = 0.25
"""What others count for a person who stands."""
_TOLERANCE = 0.2
"""Distance at which one has arrived to stay, m."""
_EXACT = 0.05
"""The same for who is to be there at a certain frame, m."""
_PASSING = 0.4
"""Distance at which one goes on, m."""
_SLOWEST, _HURRIED = 0.2, 1.9
"""Range of a speed that is to arrive in time, m/s."""
_PATIENCE = 40.0
"""After this time a leg is given up, s."""


@njit(cache=True, nogil=True)
def drive(  # type: ignore[no-untyped-def]
    active,
    position,
    velocity,
    legs,
    leg_count,
    leg,
    since,
    arrived,
    facing,
    over,
    pace,
    wander,
    party,
    walls,
    obstacles,
    frame,
    dt,
):
    """New velocities of all who are there; legs that are done give way to the next.

    Args:
        active: Who is there, indices, shape (a,).
        position: Shape (n, 2), m.
        velocity: Shape (n, 2), m/s; replaced by the velocity that forces lead to.
        legs: Shape (n, most legs, 6).
        leg_count: Number of legs, shape (n,).
        leg: The present one, shape (n,); advanced, and equal to `leg_count` when all are done.
        since: Frame at which the present leg began, shape (n,); advanced with it.
        arrived: Frame of arrival at the present leg's end, -1 before, shape (n,); changed.
        facing: Where to face, NaN while walking and for no preference, shape (n,), rad; replaced.
        over: Whose legs are all done, shape (n,), bool; changed.
        pace: Desired speed, shape (n,), m/s.
        wander: Amplitude (rad), rate (rad per frame) and phase (rad) of small changes of direction, shape (n, 3).
        party: Who belongs together, shape (n,).
        walls: z of the wall behind and of the border in front, m.
        obstacles: x, z and radius of each, shape (o, 3), m.
        frame: Number of the frame.
        dt: Between frames, s.

    Returns:
        Whether anybody's legs are all done.
    """
    count = len(active)
    someone_over = False
    wanted = np.zeros((count, 2))
    speeds = np.zeros(count)
    for a in range(count):
        i = active[a]
        distance, dx, dz = 0.0, 0.0, 0.0
        while leg[i] < leg_count[i]:
            goal = legs[i, leg[i]]
            dx, dz = goal[X] - position[i, 0], goal[Z] - position[i, 1]
            distance = math.sqrt(dx * dx + dz * dz)
            near = _TOLERANCE if goal[PAUSE] > 0.0 or goal[UNTIL] > frame else _PASSING
            if goal[DUE] >= 0.0:
                near = _EXACT
            if arrived[i] < 0 and (distance < near or (frame - since[i]) * dt > _PATIENCE):
                arrived[i] = frame
            if arrived[i] < 0 or frame - arrived[i] < goal[PAUSE] or frame < goal[UNTIL]:
                break
            leg[i] += 1
            since[i] = frame
            arrived[i] = -1
        facing[i] = math.nan
        if leg[i] >= leg_count[i]:
            over[i] = someone_over = True
            continue
        goal = legs[i, leg[i]]
        if arrived[i] >= 0:
            facing[i] = goal[FACE]
            # Those who were pushed come back slowly.
            back = 0.0 if distance < 0.5 * _TOLERANCE else 0.4
            wanted[a, 0], wanted[a, 1] = back * dx, back * dz
            speeds[a] = 0.3
            continue
        speed = pace[i]
        if goal[DUE] >= 0.0:
            speed = min(max(distance / (max(goal[DUE] - frame, 1.0) * dt), _SLOWEST), _HURRIED)
        elif goal[PAUSE] > 0.0:
            speed *= min(1.0, 0.35 + distance)
        angle = wander[i, 0] * math.sin(wander[i, 1] * frame + wander[i, 2]) * min(1.0, 0.5 * distance)
        c, s = math.cos(angle), math.sin(angle)
        wanted[a, 0] = speed * (c * dx - s * dz) / distance
        wanted[a, 1] = speed * (s * dx + c * dz) / distance
        speeds[a] = speed
    force = np.zeros((count, 2))
    turn_c, turn_s = math.cos(_KEEP_RIGHT), math.sin(_KEEP_RIGHT)
    for a in range(count):
        i = active[a]
        weight = 1.0 if math.sqrt(wanted[a, 0] ** 2 + wanted[a, 1] ** 2) > 0.15 else _STANDING
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
            if wanted[a, 0] * -gx + wanted[a, 1] * -gz < _SEEN_COSINE * speeds[a] * math.sqrt(gx * gx + gz * gz):
                gx, gz = _BEHIND * gx, _BEHIND * gz
            if party[i] == party[j]:
                gx, gz = _FAMILIAR * gx, _FAMILIAR * gz
            fx += turn_c * gx + turn_s * gz
            fz += -turn_s * gx + turn_c * gz
        for o in range(len(obstacles)):
            rx, rz = position[i, 0] - obstacles[o, 0], position[i, 1] - obstacles[o, 1]
            r = max(math.sqrt(rx * rx + rz * rz), 1e-9)
            size = _OBSTACLE_STRENGTH * math.exp(-max(r - obstacles[o, 2], 0.0) / _OBSTACLE_RANGE) / r
            # To the side on which one passes anyway.
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
        most = _FASTEST * max(speeds[a], 0.1)
        if speed > most:
            vx, vz = vx * most / speed, vz * most / speed
        velocity[i, 0], velocity[i, 1] = vx, vz
    return someone_over
