"""Simulation of people in the lobby: the social force model moves them, pymunk resolves contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import pymunk
import pymunk.batch

from servotrack.envs.track.pedestrians.floor import BACK_WALL, MIN_DEPTH
from servotrack.envs.track.pedestrians.social_force import LEG_NUMBERS, Plans, Progress, drive
from servotrack.estimators.types import Array, Labels

BODY_RADIUS = 0.2
"""Radius of a person's body, m."""
_OBSTACLE_CLEARANCE = 0.35
"""Distance between a standing person and an obstacle, m."""
_FRONT = MIN_DEPTH - 0.4
"""Front border of the floor, z in m."""
_NO_DEATH = 2**62
"""Frame of death of people without one."""
_MOTION = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY


class Stream(IntEnum):
    """Child streams of an episode's seed that decide motion. The numbers must never change."""

    ARRIVAL = 1000
    PARTY = 1001
    BODY = 1002
    SHUFFLE = 1003


@dataclass(frozen=True)
class Plan:
    """Plan of one person.

    Attributes:
        birth: Frame of entry; negative values lie before the episode.
        start: Place of entry (x, z), m.
        legs: Legs in their order, with the columns of `social_force`, shape (legs, 6).
        pace: Desired speed, m/s.
        stature: Body height, m.
        outfit_seed: Seed of the outfit.
        wander: Small changes of direction: amplitude (rad), rate (rad per frame), phase (rad).
        death: Frame at which the person disappears; None: after the last leg.
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
"""Plans of people who belong together."""


def leg(place: Array, pause: float = 0.0, until: float = 0.0, due: float = -1.0, face: float = math.nan) -> list[float]:
    """Return a leg with the columns of `social_force`."""
    return [float(place[0]), float(place[1]), pause, until, due, face]


class Walk(NamedTuple):
    """Simulated walk of one person.

    Attributes:
        plan: Plan of the person.
        first: First frame.
        positions: Position (x, z) in every frame, shape (k, 2), m.
        facing: Heading while standing, shape (k,), rad; NaN if unspecified.
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
    """Simulate the plans.

    Args:
        parties: Parties, ordered by their first birth. A party that would exceed `most` at its first birth is skipped.
        frames: Frames to simulate; the first may be negative.
        dt: Time between frames, s.
        most: Maximum number of people at a time.
        obstacles: x, z and radius of each obstacle, m.

    Returns:
        One walk per person, in the order of entry.
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
    """Simulation of all people of an episode. Those present are bodies in one pymunk Space."""

    def __init__(
        self, parties: Sequence[Sequence[Plan]], dt: float, obstacles: Sequence[tuple[float, float, float]]
    ) -> None:
        self.plans = [plan for party in parties for plan in party]
        self._dt = dt
        sizes = [len(party) for party in parties]
        self._first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        count = len(self.plans)
        longest = max((len(plan.legs) for plan in self.plans), default=1)
        legs = np.zeros((count, longest, LEG_NUMBERS))
        for row, plan in enumerate(self.plans):
            legs[row, : len(plan.legs)] = plan.legs
        self._obstacles = np.array(obstacles, dtype=np.float64).reshape(-1, 3)
        _avoid_obstacles(legs, self._obstacles)
        self._drive_plans = Plans(
            legs,
            leg_count=np.array([len(plan.legs) for plan in self.plans], dtype=np.int64),
            pace=np.array([plan.pace for plan in self.plans], dtype=np.float64),
            wander=np.array([plan.wander for plan in self.plans], dtype=np.float64).reshape(count, 3),
            party=np.repeat(np.arange(len(parties)), sizes),
        )
        self._progress = Progress(
            leg=np.zeros(count, np.int64),
            since=np.zeros(count, np.int64),
            arrived=np.full(count, -1, dtype=np.int64),
            facing=np.full(count, math.nan),
            over=np.zeros(count, np.bool_),
        )
        self._deaths = np.array([_NO_DEATH if p.death is None else p.death for p in self.plans], dtype=np.int64)
        self._position, self._velocity = np.zeros((count + 1, 2)), np.zeros((count + 1, 2))
        self._walls = np.array([BACK_WALL, _FRONT])
        self._space = pymunk.Space()
        self._space.collision_slop = 0.01
        self._bodies: dict[int, tuple[pymunk.Body, pymunk.Circle]] = {}
        self._active = np.empty(0, np.int64)
        # All bodies are read and written in one call, in the order of the Space.
        self._order = np.empty(0, np.int64)
        self._read, self._written = pymunk.batch.Buffer(), pymunk.batch.Buffer()
        self._given = np.zeros((0, 2))
        self._any_over, self._next_death = False, _NO_DEATH
        self._history: list[tuple[Labels, Array, Array]] = []
        self._entered: dict[int, int] = {}
        self._build_walls()

    @property
    def present(self) -> int:
        """Number of people present."""
        return len(self._bodies)

    def members(self, party: int) -> list[int]:
        """Return the indices of the people of a party."""
        return list(range(self._first[party], self._first[party + 1]))

    def can_enter(self, index: int) -> bool:
        """Return True if the place of entry is free. Otherwise the person waits outside."""
        near = self._space.point_query_nearest(self.plans[index].start, BODY_RADIUS, pymunk.ShapeFilter())
        return near is None

    def enter(self, index: int, frame: int) -> None:
        """Add a person, already walking."""
        plan = self.plans[index]
        body = pymunk.Body(1.0, float("inf"))
        body.position = plan.start
        shape = pymunk.Circle(body, BODY_RADIUS)
        self._space.add(body, shape)
        self._bodies[index] = (body, shape)
        goal = self._drive_plans.legs[index, 0, :2] - np.array(plan.start)
        self._position[index] = plan.start
        self._velocity[index] = plan.pace * goal / max(float(np.hypot(*goal)), 1e-9)
        self._progress.since[index] = frame
        self._entered[index] = frame
        self._note_active()

    def record(self, frame: int) -> None:
        """Remove people whose time is over, and store the positions of the others."""
        if self._any_over or frame >= self._next_death:
            active = self._active
            for index in active[self._progress.over[active] | (self._deaths[active] <= frame)].tolist():
                self._leave(index)
        active = self._active
        self._history.append((active, self._position[active], self._progress.facing[active]))

    def advance(self, frame: int) -> None:
        """Advance one frame: forces give velocities; bodies move and collide."""
        if not len(self._active):
            return
        self._any_over = drive(
            self._active, self._position, self._velocity, self._drive_plans, self._progress, self._walls,
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
        """Return the walks of all people."""
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
        """Update the indices of people present, and their order in the Space."""
        self._active = np.array(sorted(self._bodies), dtype=np.int64)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, pymunk.batch.BodyFields.BODY_ID, self._read)
        # The ground is one of the bodies; it has the last row of the arrays.
        owners = {body.id: index for index, (body, _) in self._bodies.items()}
        owners[self._space.static_body.id] = len(self.plans)
        ids = np.frombuffer(self._read.int_buf(), dtype=np.uintp).tolist()
        self._order = np.array([owners[number] for number in ids], dtype=np.int64)
        self._given = np.zeros((len(ids), 2))
        self._written.set_float_buf(self._given)
        self._next_death = int(self._deaths[self._active].min(initial=_NO_DEATH))

    def _build_walls(self) -> None:
        ground = self._space.static_body
        for z in (BACK_WALL, _FRONT):
            self._space.add(pymunk.Segment(ground, (-100.0, z), (100.0, z), 0.05))
        for x, z, radius in self._obstacles.tolist():
            self._space.add(pymunk.Circle(ground, radius, (x, z)))


def _avoid_obstacles(legs: Array, obstacles: Array) -> None:
    """Move the goals of legs that are too close to an obstacle away from its center."""
    for x, z, radius in obstacles.tolist():
        off = legs[..., :2] - [x, z]
        distance = np.hypot(off[..., 0], off[..., 1])
        free = radius + BODY_RADIUS + _OBSTACLE_CLEARANCE
        inside = distance < free
        direction = np.where(
            distance[inside, None] > 1e-6, off[inside] / np.maximum(distance[inside, None], 1e-6), [1, 0]
        )
        legs[inside, :2] = [x, z] + free * direction
