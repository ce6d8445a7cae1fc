"""Who walks over the plane under the arm, and where: plans drawn from the seed, lived by social forces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.servo.targets import PERIOD, reachable_point, solvable
from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.movement import gait
from servotrack.envs.track.pedestrians.social_force import LEG_NUMBERS, drive

Array = NDArray[np.float64]

STATURE = 1.7
"""Body height, the unit of people's gait, m."""
BODY_RADIUS = 0.2
"""Of the circle that nobody else enters, m."""

_PLAZA_RADIUS = 3.5  # of the disc in which the others stroll, m
_ELBOW_ROOM = 0.8  # between two at the start, m
_NEAR_TOOL = 1.0  # how far from the tool the person to follow starts, m
_SHORTEST, _LONGEST = 0.8, 3.5  # of the person's legs, m
_CROSSES = 0.35  # share of the others' legs that cross the person's way on the plaza
_BEYOND = (1.0, 2.0)  # how far somebody goes on after a crossing, m
_PAUSES, _PAUSE = 0.15, (20.0, 60.0)  # how often a strolling leg ends with a rest, and for how many samples
_ABREAST = 0.6  # between two who walk together, m
_WANDER = 0.12  # largest small change of direction, rad
_TRIES = 60


@dataclass(frozen=True)
class Crowd:
    """Everybody's life in one episode, K samples of P people; the person to follow is the first.

    Attributes:
        paths: Positions and velocities, shape (K, P, 4), m and m/s.
        heading: Where people face, shape (K, P), rad.
        phase: Of the gait, a stride of two steps is 2 pi. Shape (K, P), rad.
        stride: 0 standing, 1 walking at full pace. Shape (K, P).
    """

    paths: Array
    heading: Array
    phase: Array
    stride: Array


def draw_crowd(config: FollowConfig, streams: Streams, links: Array, count: int) -> Crowd:
    """Draw everybody's plans and let them live.

    Args:
        config: The world.
        streams: Of the episode.
        links: Link lengths, shape (2,), m: the person to follow walks where the arm can.
        count: Number of samples K.
    """
    rng = streams[FollowStream.PERSON]
    people, party = config.people, np.arange(config.people)
    pace = rng.uniform(*config.pace, people)
    own = _own_way(rng, config, links, float(pace[0]), count)
    nominal = _along(own, float(pace[0]), count)
    starts, plans = [own[0]], [own[1:]]
    for _ in range(config.companions):
        angle = rng.uniform(0.0, 2.0 * math.pi)
        aside = _ABREAST * np.array([math.cos(angle), math.sin(angle)])
        index = len(starts)
        party[index], pace[index] = 0, pace[0]
        starts.append(own[0] + aside)
        plans.append(own[1:] + aside)
    rng = streams[FollowStream.OTHERS]
    center = 0.9 * links
    while len(starts) < people:
        start = _free_place(rng, center, np.array(starts))
        plans.append(_others_way(rng, config, start, nominal, center, float(pace[len(starts)])))
        starts.append(start)
    legs = np.full((people, max(len(plan) for plan in plans), LEG_NUMBERS), math.nan)
    legs[:, :, 2:4], legs[:, :, 4] = 0.0, -1.0
    for row, plan in enumerate(plans):
        legs[row, : len(plan), :2] = plan
    rests = rng.random(legs.shape[:2]) < _PAUSES
    pauses = rng.uniform(*_PAUSE, legs.shape[:2])
    if config.script == "plaza":
        # Who walks with somebody rests with them.
        together = party == 0
        rests[together], pauses[together] = rests[0], pauses[0]
        legs[:, :, 2] = np.where(rests, pauses, 0.0)
    wander = np.stack(
        [rng.uniform(0.0, _WANDER, people), rng.uniform(0.02, 0.08, people), rng.uniform(0.0, 2 * math.pi, people)],
        axis=-1,
    )
    number = np.array([len(plan) for plan in plans], dtype=np.int64)
    paths = np.empty((count, people, 4))
    _live(np.array(starts), legs, number, pace, wander, party, PERIOD, paths)
    moved = np.diff(paths[:, :, :2], axis=0, prepend=paths[:1, :, :2]) / STATURE
    resting = np.full(count, math.nan)
    bodies = np.stack([gait(np.ascontiguousarray(moved[:, i]), resting, math.nan, 0.0, PERIOD) for i in range(people)])
    heading, phase, stride = np.ascontiguousarray(bodies.transpose(2, 1, 0))
    return Crowd(paths, heading, phase + rng.uniform(0.0, 2.0 * math.pi, people), stride)


def _own_way(rng: np.random.Generator, config: FollowConfig, links: Array, pace: float, count: int) -> Array:
    """Places that the person to follow goes to, the start first, straight ways that the arm can follow. (k, 2) m."""
    places = [_first_place(rng, links)]
    left = 1.3 * pace * count * PERIOD
    while left > 0.0:
        here = places[-1]
        there = here
        for _ in range(_TRIES):
            candidate = reachable_point(rng, links)
            length = float(np.hypot(*(candidate - here)))
            if not _SHORTEST < length < _LONGEST:
                continue
            samples = np.linspace(here, candidate, max(3, int(length / (pace * PERIOD))))
            if solvable(samples, links[0], links[1], config.max_joint_rate):
                there = candidate
                break
        places.append(there)
        left -= max(float(np.hypot(*(there - here))), pace)
    return np.array(places)


def _first_place(rng: np.random.Generator, links: Array) -> Array:
    """Near the tool at reset, within the arm's reach."""
    for _ in range(_TRIES):
        angle, distance = rng.uniform(0.0, 2.0 * math.pi), _NEAR_TOOL * math.sqrt(rng.random())
        place = links + distance * np.array([math.cos(angle), math.sin(angle)])
        if solvable(place[None], links[0], links[1], 1.0):
            return place
    return links.copy()


def _along(places: Array, pace: float, count: int) -> Array:
    """Where somebody would be who walks from place to place without anybody in the way, shape (count, 2)."""
    lengths = np.hypot(*np.diff(places, axis=0).T)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    way = pace * PERIOD * np.arange(count)
    return np.stack([np.interp(way, at, places[:, axis]) for axis in range(2)], axis=-1)


def _free_place(rng: np.random.Generator, center: Array, taken: Array) -> Array:
    """A place of the plaza where nobody stands; the freest of many where it is crowded."""
    angle, radius = rng.uniform(0.0, 2.0 * math.pi, _TRIES), _PLAZA_RADIUS * np.sqrt(rng.random(_TRIES))
    places = center + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    room = np.hypot(*(places[:, None] - taken).transpose(2, 0, 1)).min(axis=1)
    free = np.flatnonzero(room > _ELBOW_ROOM)
    return places[free[0] if len(free) else int(room.argmax())]


def _others_way(
    rng: np.random.Generator, config: FollowConfig, start: Array, nominal: Array, center: Array, pace: float
) -> Array:
    """Places that one of the others goes to, (k, 2) m."""
    crosses = 1.0 if config.script == "crossings" else _CROSSES
    here, sample, places = start, 0, []
    while sample < 1.3 * len(nominal):
        there = center + _PLAZA_RADIUS * np.sqrt(rng.random()) * _direction(rng.uniform(0.0, 2.0 * math.pi))
        beyond, wants = rng.uniform(*_BEYOND), rng.random() < crosses
        meeting = _meeting(here, sample, nominal, pace) if wants else None
        if meeting is not None:
            way = meeting - here
            there = meeting + beyond * way / max(float(np.hypot(*way)), 1e-9)
        out = there - center
        there = center + out * min(1.0, _PLAZA_RADIUS / max(float(np.hypot(*out)), 1e-9))
        places.append(there)
        sample += max(int(np.hypot(*(there - here)) / (pace * PERIOD)), 10)
        here = there
    return np.array(places)


def _direction(angle: float) -> Array:
    return np.array([math.cos(angle), math.sin(angle)])


def _meeting(here: Array, sample: int, nominal: Array, pace: float) -> Array | None:
    """Where somebody who sets out now in a straight line meets a walker; None where they cannot catch up."""
    ahead = nominal[sample:]
    late = np.hypot(*(ahead - here).T) - pace * PERIOD * np.arange(len(ahead))
    met = np.flatnonzero(late[10:] < 0.0)
    return ahead[10 + met[0]] if len(met) else None


@njit(cache=True, nogil=True)
def _live(starts, legs, number, pace, wander, party, dt, paths):  # type: ignore[no-untyped-def]
    """Walk everybody through all samples; who touches another is pushed off."""
    people = starts.shape[0]
    active = np.arange(people)
    position, velocity = starts.copy(), np.zeros((people, 2))
    leg, since = np.zeros(people, np.int64), np.zeros(people, np.int64)
    arrived, over = np.full(people, -1), np.zeros(people, np.bool_)
    facing = np.full(people, math.nan)
    walls, nothing = np.array([-1e3, 1e3]), np.zeros((0, 3))
    for i in range(people):
        dx, dy = legs[i, 0, 0] - starts[i, 0], legs[i, 0, 1] - starts[i, 1]
        length = max(math.hypot(dx, dy), 1e-9)
        velocity[i, 0], velocity[i, 1] = pace[i] * dx / length, pace[i] * dy / length
    for sample in range(paths.shape[0]):
        for i in range(people):
            paths[sample, i, 0], paths[sample, i, 1] = position[i, 0], position[i, 1]
        drive(
            active, position, velocity, legs, number, leg, since, arrived, facing, over, pace, wander, party, walls,
            nothing, sample, dt,
        )  # fmt: skip
        for i in range(people):
            position[i, 0] += dt * velocity[i, 0]
            position[i, 1] += dt * velocity[i, 1]
        for i in range(people):
            for j in range(i):
                dx, dy = position[i, 0] - position[j, 0], position[i, 1] - position[j, 1]
                distance = math.hypot(dx, dy)
                if 1e-9 < distance < 2.0 * BODY_RADIUS:
                    push = (BODY_RADIUS - 0.5 * distance) / distance
                    position[i, 0] += push * dx
                    position[i, 1] += push * dy
                    position[j, 0] -= push * dx
                    position[j, 1] -= push * dy
        for i in range(people):
            # What bodies made of it, not what they wanted.
            for axis in range(2):
                velocity[i, axis] = (position[i, axis] - paths[sample, i, axis]) / dt
                paths[sample, i, 2 + axis] = velocity[i, axis]
