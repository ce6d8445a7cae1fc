"""People who walk the lobby by their plans: social forces move them, pymunk's bodies keep them apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import pymunk
import pymunk.batch

from servotrack.envs.track.pedestrians.floor import BACK_WALL, NEAR
from servotrack.envs.track.pedestrians.social_force import LEG_NUMBERS, drive
from servotrack.estimators.types import Array, Labels

BODY_RADIUS = 0.2
"""Of the circle that nobody enters, m."""
_ELBOW_ROOM = 0.35
"""Between somebody who stands and an obstacle, m."""
_FRONT = NEAR - 0.4
_NEVER = 2**62
_MOTION = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY


class Stream(IntEnum):
    """Child streams of an episode's seed that decide motion; those of the picture lie elsewhere. Never change one."""

    ARRIVAL = 1000
    PARTY = 1001
    BODY = 1002
    SHUFFLE = 1003


@dataclass(frozen=True)
class Plan:
    """What one person is going to do.

    Attributes:
        birth: Frame at which they come, from 0; below it before the episode.
        start: Where they come, (x, z), m.
        legs: Where they go one after the other, rows as `social_force` names them. Shape (legs, 6).
        pace: Speed they like, m/s.
        stature: Body height, m.
        outfit_seed: Seed of how they look.
        wander: Small changes of direction: amplitude (rad), rate (rad per frame), phase (rad).
        death: Frame at which they are gone; None: when their legs are done.
    """

    birth: int
    start: tuple[float, float]
    legs: Array
    pace: float
    stature: float
    outfit_seed: int
    wander: tuple[float, float, float]
    death: int | None = None


Party = list[Plan]
"""Those who belong together."""


def leg(place: Array, pause: float = 0.0, until: float = 0.0, due: float = -1.0, face: float = math.nan) -> list[float]:
    """A leg as `social_force` wants it."""
    return [float(place[0]), float(place[1]), pause, until, due, face]


class Walk(NamedTuple):
    """What one person did.

    Attributes:
        plan: What they had planned.
        first: First frame.
        positions: (x, z) in every frame of their life. Shape (k, 2), m.
        facing: Where they meant to face while they stood, NaN for no preference. Shape (k,), rad.
    """

    plan: Plan
    first: int
    positions: Array
    facing: Array


def walk(
    parties: Sequence[Sequence[Plan]],
    frames: range,
    dt: float,
    most: int,
    obstacles: Sequence[tuple[float, float, float]] = (),
) -> list[Walk]:
    """Let people live their plans.

    Args:
        parties: Plans of those who belong together, ordered by the first birth. A party that would be too many when
            its first comes stays away.
        frames: The frames to simulate; the first may lie before 0.
        dt: Between frames, s.
        most: Most people at a time.
        obstacles: What nobody can walk through: x, z and radius of each, m.

    Returns:
        One walk per person, in the order in which they came.
    """
    simulation = _Simulation(parties, dt, obstacles)
    births = [min(plan.birth for plan in party) for party in parties]
    coming = 0
    members: list[int] = []
    for frame in frames:
        while coming < len(parties) and births[coming] <= frame:
            if simulation.present + len(members) + len(parties[coming]) <= most:
                members += simulation.members(coming)
            coming += 1
        for index in [i for i in members if simulation.plans[i].birth <= frame]:
            if simulation.can_enter(index):
                members.remove(index)
                simulation.enter(index, frame)
        simulation.record(frame)
        simulation.advance(frame)
    return simulation.walks()


class _Simulation:
    """All people of an episode, those who are there as bodies in one pymunk Space."""

    def __init__(
        self, parties: Sequence[Sequence[Plan]], dt: float, obstacles: Sequence[tuple[float, float, float]]
    ) -> None:
        self.plans = [plan for party in parties for plan in party]
        self._dt = dt
        sizes = [len(party) for party in parties]
        self._first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self._party = np.repeat(np.arange(len(parties)), sizes)
        count = len(self.plans)
        longest = max((len(plan.legs) for plan in self.plans), default=1)
        self._legs = np.zeros((count, longest, LEG_NUMBERS))
        for row, plan in enumerate(self.plans):
            self._legs[row, : len(plan.legs)] = plan.legs
        self._obstacles = np.array(obstacles, dtype=np.float64).reshape(-1, 3)
        _step_aside(self._legs, self._obstacles)
        self._leg_count = np.array([len(plan.legs) for plan in self.plans], dtype=np.int64)
        self._leg, self._since = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._arrived = np.full(count, -1, dtype=np.int64)
        self._facing, self._over = np.full(count, math.nan), np.zeros(count, np.bool_)
        self._deaths = np.array([_NEVER if p.death is None else p.death for p in self.plans], dtype=np.int64)
        self._pace = np.array([plan.pace for plan in self.plans], dtype=np.float64)
        self._wander = np.array([plan.wander for plan in self.plans], dtype=np.float64).reshape(count, 3)
        self._position, self._velocity = np.zeros((count + 1, 2)), np.zeros((count + 1, 2))
        self._walls = np.array([BACK_WALL, _FRONT])
        self._space = pymunk.Space()
        self._space.collision_slop = 0.01
        self._bodies: dict[int, tuple[pymunk.Body, pymunk.Circle]] = {}
        self._active = np.empty(0, np.int64)
        # All bodies' numbers are read and written in one call; the Space has them in an order of its own.
        self._order = np.empty(0, np.int64)
        self._read, self._written = pymunk.batch.Buffer(), pymunk.batch.Buffer()
        self._given = np.zeros((0, 2))
        self._someone_over, self._next_death = False, _NEVER
        self._history: list[tuple[Labels, Array, Array]] = []
        self._entered: dict[int, int] = {}
        self._build_walls()

    @property
    def present(self) -> int:
        """How many are there."""
        return len(self._bodies)

    def members(self, party: int) -> list[int]:
        """Who belongs to a party."""
        return list(range(self._first[party], self._first[party + 1]))

    def can_enter(self, index: int) -> bool:
        """Whether nobody stands where somebody is to come; otherwise they wait outside."""
        near = self._space.point_query_nearest(self.plans[index].start, BODY_RADIUS, pymunk.ShapeFilter())
        return near is None

    def enter(self, index: int, frame: int) -> None:
        """Somebody comes, already walking."""
        plan = self.plans[index]
        body = pymunk.Body(1.0, float("inf"))
        body.position = plan.start
        shape = pymunk.Circle(body, BODY_RADIUS)
        self._space.add(body, shape)
        self._bodies[index] = (body, shape)
        goal = self._legs[index, 0, :2] - np.array(plan.start)
        self._position[index] = plan.start
        self._velocity[index] = plan.pace * goal / max(float(np.hypot(*goal)), 1e-9)
        self._since[index] = frame
        self._entered[index] = frame
        self._note_active()

    def record(self, frame: int) -> None:
        """Note where everybody is; those whose time is over are gone."""
        if self._someone_over or frame >= self._next_death:
            active = self._active
            for index in active[self._over[active] | (self._deaths[active] <= frame)].tolist():
                self._leave(index)
        active = self._active
        self._history.append((active, self._position[active], self._facing[active]))

    def advance(self, frame: int) -> None:
        """One step of time: forces give velocities, bodies move with them and stop each other."""
        if not len(self._active):
            return
        self._someone_over = drive(
            self._active, self._position, self._velocity, self._legs, self._leg_count, self._leg, self._since,
            self._arrived, self._facing, self._over, self._pace, self._wander, self._party, self._walls,
            self._obstacles, frame, self._dt,
        )  # fmt: skip
        self._given[:] = self._velocity[self._order]
        pymunk.batch.set_space_bodies(self._space, pymunk.batch.BodyFields.VELOCITY, self._written)
        self._space.step(self._dt)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, _MOTION, self._read)
        moved = np.frombuffer(self._read.float_buf()).reshape(-1, 4)
        self._position[self._order], self._velocity[self._order] = moved[:, :2], moved[:, 2:]

    def walks(self) -> list[Walk]:
        """What everybody did."""
        if not self._history:
            return []
        who, positions, facing = (np.concatenate(parts) for parts in zip(*self._history, strict=True))
        found = []
        for index, first in self._entered.items():
            mine = np.flatnonzero(who == index)
            if len(mine):
                found.append(Walk(self.plans[index], first, positions[mine], facing[mine]))
        return found

    def _leave(self, index: int) -> None:
        self._space.remove(*self._bodies.pop(index))
        self._note_active()

    def _note_active(self) -> None:
        """Who is there, and in which order the Space has them."""
        self._active = np.array(sorted(self._bodies), dtype=np.int64)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, pymunk.batch.BodyFields.BODY_ID, self._read)
        # The ground is among them; the last row of the arrays is its own.
        owners = {body.id: index for index, (body, _) in self._bodies.items()}
        owners[self._space.static_body.id] = len(self.plans)
        ids = np.frombuffer(self._read.int_buf(), dtype=np.uintp).tolist()
        self._order = np.array([owners[number] for number in ids], dtype=np.int64)
        self._given = np.zeros((len(ids), 2))
        self._written.set_float_buf(self._given)
        self._next_death = int(self._deaths[self._active].min(initial=_NEVER))

    def _build_walls(self) -> None:
        ground = self._space.static_body
        for z in (BACK_WALL, _FRONT):
            self._space.add(pymunk.Segment(ground, (-100.0, z), (100.0, z), 0.05))
        for x, z, radius in self._obstacles.tolist():
            self._space.add(pymunk.Circle(ground, radius, (x, z)))


def _step_aside(legs: Array, obstacles: Array) -> None:
    """Move places that are in or at an obstacle off it, away from its middle."""
    for x, z, radius in obstacles.tolist():
        off = legs[..., :2] - [x, z]
        distance = np.hypot(off[..., 0], off[..., 1])
        free = radius + BODY_RADIUS + _ELBOW_ROOM
        inside = distance < free
        direction = np.where(
            distance[inside, None] > 1e-6, off[inside] / np.maximum(distance[inside, None], 1e-6), [1, 0]
        )
        legs[inside, :2] = [x, z] + free * direction
