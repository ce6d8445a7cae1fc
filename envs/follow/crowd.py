"""Paths of the people who walk under the arm: waypoints drawn from the seed, walked with social forces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.servo.layout import starts_in_view
from servotrack.envs.servo.targets import LEAD, PERIOD, reachable_place, solvable
from servotrack.envs.streams import draw_share, draw_uniform, start_stream
from servotrack.envs.track.pedestrians.movement import gait
from servotrack.envs.track.pedestrians.social_force import DUE, LEG_NUMBERS, PAUSE, UNTIL, Plans, Progress, drive
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

STATURE = 1.7
"""Body height, the length unit of the gait, m."""
BODY_RADIUS = 0.2
"""Radius of a person's body. Two bodies never overlap, m."""

_PLAZA_RADIUS = 3.5  # radius of the disc in which the others stroll, m
_START_SPACING = 0.8  # distance between two people at the start, m
_START_RADIUS = 1.0  # largest distance of the person to follow from the tool at the start, m
_SHORTEST_LEG, _LONGEST_LEG = 0.8, 3.5  # lengths of the legs of the person to follow, m
_CROSSING_SHARE = 0.35  # share of the others' legs that cross the person's path, in the script `plaza`
_OVERSHOOT = (1.0, 2.0)  # distance that a person walks on after a crossing, m
_REST_PROBABILITY, _REST_SAMPLES = 0.15, (20.0, 60.0)  # that a strolling leg ends with a rest; its length, samples
_COMPANION_DISTANCE = 0.6  # between two people who walk together, m
_WANDER = 0.12  # largest amplitude of slow changes of direction, rad
_PLAN_MARGIN = 1.3  # plans last this many times the episode, because some people walk faster than their pace
_SHORTEST_LEG_SAMPLES = 10  # shortest duration of a leg of the others, samples
_TRIES = 60


@dataclass(frozen=True)
class Crowd:
    """Paths and gait of all people in one episode, K samples of P people. The person to follow is the first one.

    Attributes:
        paths: Positions and velocities. Shape (K, P, 4), m and m/s.
        first_phase: Phase of each person's gait before the first step. Shape (P,), rad.
    """

    paths: Array
    first_phase: Array

    @cached_property
    def walk(self) -> Array:
        """Heading (rad), phase of the gait (rad) and stride of all people. Shape (K, P, 3).

        A stride of two steps is 2 pi of the phase. The stride is the gait's amplitude: 0 standing, 1 walking at full
        pace. Only pictures need it, so it is computed when it is first used.
        """
        return self.first_walk(len(self.paths))

    def first_walk(self, count: int) -> Array:
        """Return the first `count` samples of `walk`, at least 6: these decide the first heading."""
        walk = np.empty((count, len(self.first_phase), 3))
        _move_bodies(self.paths[:count], self.first_phase, walk)
        return walk


class CrowdRanges(NamedTuple):
    """Ranges that paths are drawn from, see `FollowConfig`.

    Attributes:
        people: Number of people P.
        companions: Number of people who walk with the person to follow.
        pace: Range of the walking speeds, m/s.
        crosses: Share of the others' legs that cross the person's path.
        rests: True if legs end with a rest now and then.
        max_joint_rate: Largest joint rate of the arm, rad/s.
        camera_size: Width and height of the camera's image, px.
        first: First sample at which the arm must be able to follow.
    """

    people: int
    companions: int
    pace: tuple[float, float]
    crosses: float
    rests: bool
    max_joint_rate: float
    camera_size: float
    first: int


def crowd_ranges_of(config: FollowConfig) -> CrowdRanges:
    """Return the ranges that a configuration draws paths from."""
    return CrowdRanges(
        people=config.people,
        companions=config.companions,
        pace=config.pace,
        crosses=1.0 if config.script == "crossings" else _CROSSING_SHARE,
        rests=config.script == "plaza",
        max_joint_rate=config.max_joint_rate,
        camera_size=float(config.camera_size),
        first=LEAD + config.warmup,
    )


@njit(cache=True, nogil=True)
def start_crowd_streams(seed):  # type: ignore[no-untyped-def]
    """Start the streams of the person to follow and of the others, (2, 4) uint64."""
    states = np.empty((2, 4), np.uint64)
    start_stream(seed, FollowStream.PERSON.value, states[0])
    start_stream(seed, FollowStream.OTHERS.value, states[1])
    return states


@njit(cache=True, nogil=True)
def draw_paths(ranges, states, arm, count):  # type: ignore[no-untyped-def]
    """Draw the waypoints of all people and simulate them while the arm can follow the first one.

    Args:
        ranges: Ranges, `CrowdRanges`.
        states: Streams of the person to follow and of the others, (2, 4).
        arm: Links, camera and goal, a record of `CONSTANTS`. The person to follow starts in view, and walks only where
            the arm can reach.
        count: Number of samples K.

    Returns:
        Positions and velocities like `Crowd.paths`. Rows after the arm could not follow are zeros; such an episode is
            drawn again.
    """
    people, party, state, others = ranges.people, np.arange(ranges.people), states[0], states[1]
    links = arm.links
    pace, starts = np.empty(people), np.empty((people, 2))
    for i in range(people):
        pace[i] = draw_uniform(state, ranges.pace[0], ranges.pace[1])
    own = _draw_own_waypoints(state, ranges, links, pace[0], count)
    longest = math.ceil(_PLAN_MARGIN * count / _SHORTEST_LEG_SAMPLES)
    plans, number = np.empty((people, max(longest, len(own)), 2)), np.empty(people, np.int64)
    starts[0], number[0], known = own[0], len(own) - 1, 1
    plans[0, : number[0]] = own[1:]
    for _ in range(ranges.companions):
        angle = draw_uniform(state, 0.0, 2.0 * math.pi)
        aside = _COMPANION_DISTANCE * math.cos(angle), _COMPANION_DISTANCE * math.sin(angle)
        party[known], pace[known], number[known] = 0, pace[0], number[0]
        for axis in range(2):
            starts[known, axis] = own[0, axis] + aside[axis]
            plans[known, : number[0], axis] = own[1:, axis] + aside[axis]
        known += 1
    center, nominal = 0.9 * links, np.empty((count, 2))
    _walk_along(own, pace[0] * PERIOD, nominal)
    for i in range(known, people):
        starts[i] = _free_place(_draw_shares(others, _TRIES, 2), center, starts[:i])
        shares = _draw_shares(others, longest, 4)
        number[i] = _fill_other_waypoints(shares, ranges.crosses, starts[i], nominal, center, pace[i], plans[i])
    legs = np.full((people, number.max(), LEG_NUMBERS), math.nan)
    legs[:, :, PAUSE : UNTIL + 1], legs[:, :, DUE] = 0.0, -1.0
    for i in range(people):
        legs[i, : number[i], :PAUSE] = plans[i, : number[i]]
    rests, pauses = _draw_shares(others, people, legs.shape[1]), _draw_shares(others, people, legs.shape[1])
    if ranges.rests:
        for i in range(people):
            # Companions rest together.
            same = 0 if party[i] == 0 else i
            for k in range(legs.shape[1]):
                if rests[same, k] < _REST_PROBABILITY:
                    legs[i, k, PAUSE] = _REST_SAMPLES[0] + (_REST_SAMPLES[1] - _REST_SAMPLES[0]) * pauses[same, k]
    wander = np.empty((people, 3))
    for column, low, high in ((0, 0.0, _WANDER), (1, 0.02, 0.08), (2, 0.0, 2.0 * math.pi)):
        for i in range(people):
            wander[i, column] = draw_uniform(others, low, high)
    paths = np.zeros((count, people, 4))
    _simulate(
        starts, legs, number, pace, wander, party, PERIOD, ranges.first, arm, ranges, paths,
    )  # fmt: skip
    return paths


@njit(cache=True, nogil=True)
def draw_first_phases(states, people):  # type: ignore[no-untyped-def]
    """Draw the first phase of each person's gait, (P,) rad, after their paths."""
    phases = np.empty(people)
    for i in range(people):
        phases[i] = draw_uniform(states[1], 0.0, 2.0 * math.pi)
    return phases


@njit(cache=True, nogil=True)
def _draw_shares(state, rows, columns):  # type: ignore[no-untyped-def]
    """Draw from [0, 1), shape (rows, columns)."""
    shares = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            shares[i, j] = draw_share(state)
    return shares


@njit(cache=True, nogil=True)
def _move_bodies(paths, first_phase, walk):  # type: ignore[no-untyped-def]
    """Fill in heading, phase and stride of all people, (K, P, 3)."""
    count, people = paths.shape[:2]
    moved, resting = np.zeros((count, 2)), np.full(count, math.nan)
    for i in range(people):
        for k in range(1, count):
            moved[k, 0] = (paths[k, i, 0] - paths[k - 1, i, 0]) / STATURE
            moved[k, 1] = (paths[k, i, 1] - paths[k - 1, i, 1]) / STATURE
        body = gait(moved, resting, math.nan, 0.0, PERIOD)
        for k in range(count):
            walk[k, i, 0], walk[k, i, 1], walk[k, i, 2] = body[k, 0], body[k, 1] + first_phase[i], body[k, 2]


@njit(cache=True, nogil=True)
def _draw_own_waypoints(state, ranges, links, pace, count):  # type: ignore[no-untyped-def]
    """Waypoints of the person to follow, start first. The arm can follow the straight legs between them. (k, 2) m."""
    left = _PLAN_MARGIN * pace * count * PERIOD
    places = np.empty((math.ceil(_PLAN_MARGIN * count * PERIOD) + 2, 2))
    places[0] = _first_place(_draw_shares(state, _TRIES, 2), links)
    shares = _draw_shares(state, len(places) * _TRIES, 2).reshape(len(places), _TRIES, 2)
    return places[: _fill_own_waypoints(shares, links, pace, left, ranges.max_joint_rate, places)]


@njit(cache=True, nogil=True)
def _first_place(shares, links):  # type: ignore[no-untyped-def]
    """Draw a start near the tool's position at reset, within the arm's reach."""
    place = np.empty((1, 2))
    for share in shares:
        angle, distance = 2.0 * math.pi * share[0], _START_RADIUS * math.sqrt(share[1])
        place[0, 0], place[0, 1] = links[0] + distance * math.cos(angle), links[1] + distance * math.sin(angle)
        if solvable(place, links[0], links[1], 1.0):
            return place[0]
    return links.copy()


@njit(cache=True, nogil=True)
def _fill_own_waypoints(shares, links, pace, left, max_joint_rate, places):  # type: ignore[no-untyped-def]
    """Fill `places` from the second row on until the path is `left` m long; returns the number of places."""
    number = 1
    way = np.empty((int(_LONGEST_LEG / (pace * PERIOD)) + 3, 2))
    while left > 0.0:
        here, there = places[number - 1], places[number]
        there[:] = here
        done = pace
        for share in shares[number]:
            x, y = reachable_place(share[0], share[1], links[0], links[1])
            length = math.hypot(x - here[0], y - here[1])
            if not _SHORTEST_LEG < length < _LONGEST_LEG:
                continue
            samples = max(3, int(length / (pace * PERIOD)))
            for k in range(samples):
                f = k / (samples - 1)
                way[k, 0], way[k, 1] = here[0] + f * (x - here[0]), here[1] + f * (y - here[1])
            if solvable(way[:samples], links[0], links[1], max_joint_rate):
                there[0], there[1] = x, y
                done = max(length, pace)
                break
        left -= done
        number += 1
    return number


@njit(cache=True, nogil=True)
def _walk_along(places, step, out):  # type: ignore[no-untyped-def]
    """Fill `out` with the positions of an undisturbed walker between the places, `step` m further in every row."""
    leg, walked = 0, 0.0
    length = math.hypot(places[1, 0] - places[0, 0], places[1, 1] - places[0, 1])
    for k in range(out.shape[0]):
        while step * k > walked + length and leg < places.shape[0] - 2:
            walked += length
            leg += 1
            length = math.hypot(places[leg + 1, 0] - places[leg, 0], places[leg + 1, 1] - places[leg, 1])
        f = min((step * k - walked) / max(length, 1e-9), 1.0)
        for axis in range(2):
            out[k, axis] = places[leg, axis] + f * (places[leg + 1, axis] - places[leg, axis])


@njit(cache=True, nogil=True)
def _free_place(shares, center, taken):  # type: ignore[no-untyped-def]
    """Draw a free place of the plaza; where it is crowded, the place with the most room of all tries."""
    best, most = np.empty(2), -1.0
    for share in shares:
        x, y = _plaza_place(share[0], share[1], center)
        room = np.inf
        for other in taken:
            room = min(room, math.hypot(x - other[0], y - other[1]))
        if room > most:
            best[0], best[1], most = x, y, room
        if room > _START_SPACING:
            break
    return best


@njit(cache=True, nogil=True)
def _plaza_place(turn, area, center):  # type: ignore[no-untyped-def]
    """Map two uniform numbers in [0, 1] to a place of the plaza."""
    angle, radius = 2.0 * math.pi * turn, _PLAZA_RADIUS * math.sqrt(area)
    return center[0] + radius * math.cos(angle), center[1] + radius * math.sin(angle)


@njit(cache=True, nogil=True)
def _fill_other_waypoints(shares, crosses, start, nominal, center, pace, places):  # type: ignore[no-untyped-def]
    """Fill `places` with the waypoints of one of the others; returns their number."""
    x, y = start[0], start[1]
    sample, number = 0, 0
    while sample < _PLAN_MARGIN * nominal.shape[0]:
        share = shares[number]
        to_x, to_y = _plaza_place(share[0], share[1], center)
        if share[2] < crosses:
            met = _meeting(x, y, sample, nominal, pace)
            if met >= 0:
                dx, dy = nominal[met, 0] - x, nominal[met, 1] - y
                beyond = _OVERSHOOT[0] + (_OVERSHOOT[1] - _OVERSHOOT[0]) * share[3]
                longer = 1.0 + beyond / max(math.hypot(dx, dy), 1e-9)
                to_x, to_y = x + longer * dx, y + longer * dy
        out_x, out_y = to_x - center[0], to_y - center[1]
        inward = min(1.0, _PLAZA_RADIUS / max(math.hypot(out_x, out_y), 1e-9))
        to_x, to_y = center[0] + inward * out_x, center[1] + inward * out_y
        sample += max(int(math.hypot(to_x - x, to_y - y) / (pace * PERIOD)), _SHORTEST_LEG_SAMPLES)
        x, y = to_x, to_y
        places[number, 0], places[number, 1] = x, y
        number += 1
    return number


@njit(cache=True, nogil=True)
def _meeting(x, y, sample, nominal, pace):  # type: ignore[no-untyped-def]
    """Return the sample at which a person who starts now on a straight line meets the walker, or -1."""
    for k in range(sample + _SHORTEST_LEG_SAMPLES, nominal.shape[0]):
        if math.hypot(nominal[k, 0] - x, nominal[k, 1] - y) < pace * PERIOD * (k - sample):
            return k
    return -1


@njit(cache=True, nogil=True)
def _simulate(  # type: ignore[no-untyped-def]
    starts, legs, number, pace, wander, party, dt, first, arm, ranges, paths
):
    """Simulate all people through all samples, as long as the arm can follow the first one from sample `first` on.

    They also stop where the first one is not in view when the arm starts.

    Bodies that overlap are pushed apart.
    """
    people, links = starts.shape[0], arm.links
    active = np.arange(people)
    position, velocity = starts.copy(), np.zeros((people, 2))
    plans = Plans(legs, number, pace, wander, party)
    progress = Progress(
        np.zeros(people, np.int64),
        np.zeros(people, np.int64),
        np.full(people, -1),
        np.full(people, math.nan),
        np.zeros(people, np.bool_),
    )
    walls, nothing = np.array([-1e3, 1e3]), np.zeros((0, 3))
    for i in range(people):
        dx, dy = legs[i, 0, 0] - starts[i, 0], legs[i, 0, 1] - starts[i, 1]
        length = max(math.hypot(dx, dy), 1e-9)
        velocity[i, 0], velocity[i, 1] = pace[i] * dx / length, pace[i] * dy / length
    for sample in range(paths.shape[0]):
        for i in range(people):
            paths[sample, i, 0], paths[sample, i, 1] = position[i, 0], position[i, 1]
        if not solvable(paths[max(sample - 1, first) : sample + 1, 0], links[0], links[1], ranges.max_joint_rate):
            return
        if sample == LEAD and not starts_in_view(arm, ranges.camera_size, position[0, 0], position[0, 1]):
            return
        drive(active, position, velocity, plans, progress, walls, nothing, sample, dt)
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
            # The velocity after collisions, not the intended one.
            for axis in range(2):
                velocity[i, axis] = (position[i, axis] - paths[sample, i, axis]) / dt
                paths[sample, i, 2 + axis] = velocity[i, axis]
