"""Random scripts: arrival times and plans of the visitors of the lobby."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.floor import MAX_DEPTH, MIN_DEPTH, Camera
from servotrack.envs.track.pedestrians.paper_script import meet_split_third_guy
from servotrack.envs.track.pedestrians.scene import Party, Plan, Stream, leg
from servotrack.estimators.types import Array

ENTRY_DISTANCE = 0.55
"""Distance outside the image border at which people enter and leave, m."""
WARM_UP = 14.0
"""Simulated time before the first populated frame, s, so that the lobby has its usual population then."""

_ARRIVAL_SHAPE = 4.0
"""Shape parameter of the gamma distributed gaps between arrivals. Larger values give more regular arrivals; 1 would be
a Poisson process, with very empty and very full episodes."""

_RESIDENCE = {"random": 13.3, "crossing": 10.5, "crowd": 14.1}
"""Measured mean time that a person is in sight, s. It makes `people` the mean number of people."""
_PARTY_SIZE = {"random": 1.4, "crossing": 1.2, "crowd": 1.85}
"""Mean number of people in a party."""
_DOORS = ((-1, 7.4), (-1, 9.6), (-1, 13.0), (1, 7.4), (1, 9.6), (1, 13.0))
"""Side and depth (m) of the doors at which people enter and leave."""
_SPACING = 0.6
"""Distance between people who walk or stand together, m."""


def draw_parties(config: PedestrianConfig, camera: Camera, seed: int) -> tuple[list[Party], range]:
    """Draw the parties of an episode.

    Args:
        config: Parameters of the environment, with any script except `replay`.
        camera: Camera of the lobby.
        seed: Seed of the episode.

    Returns:
        Parties, ordered by their first birth, and the frames to simulate.
    """
    streams = Streams(seed)
    if config.script == "meet_split_third_guy":
        return meet_split_third_guy(config, camera, streams), range(config.horizon + 1)
    begin = config.empty_frames - round(WARM_UP * config.frame_rate)
    frames = range(min(begin, config.horizon + 1), config.horizon + 1)
    if config.people == 0.0:
        return [], frames
    arrivals = streams[Stream.ARRIVAL]
    rate = config.people / (_RESIDENCE[config.script] * _PARTY_SIZE[config.script] * config.frame_rate)
    # Number of gaps that suffices except with negligible probability.
    expected = rate * len(frames)
    gaps = arrivals.gamma(
        _ARRIVAL_SHAPE, 1.0 / (_ARRIVAL_SHAPE * rate), round(expected + 8.0 * math.sqrt(expected) + 16.0)
    )
    births = begin + np.floor(np.cumsum(gaps)).astype(np.int64)
    visit = _VISITS[config.script]
    parties = []
    for number, birth in enumerate(births[births < frames.stop].tolist()):
        parties.append(visit(_Lobby(config, camera, streams, number), birth))
    parties.sort(key=lambda party: min(plan.birth for plan in party))
    return parties, frames


class _Lobby:
    """Random draws for the plans of one party, from its own streams."""

    def __init__(self, config: PedestrianConfig, camera: Camera, streams: Streams, number: int) -> None:
        self._camera = camera
        self.rate = config.frame_rate
        self.rng = streams[Stream.PARTY, number]
        self._body = streams[Stream.BODY, number]

    def chance(self, probability: float) -> bool:
        """Return True with this probability."""
        return bool(self.rng.random() < probability)

    def door(self, but_side: int = 0) -> tuple[int, float]:
        """Draw side and depth (m) of a door that is not on the side `but_side`."""
        side, depth = _DOORS[int(self.rng.integers(len(_DOORS)))]
        return (-but_side if side == but_side else side), depth + float(self.rng.uniform(-0.9, 0.9))

    def outside(self, door: tuple[int, float]) -> Array:
        """Return the point of the floor outside a door, m."""
        side, depth = door
        return np.array([side * (float(self._camera.half_width(depth)) + ENTRY_DISTANCE), depth])

    def spot(self, side: int) -> Array:
        """Draw a visible place in one half of the image, away from its border."""
        depth = float(self.rng.uniform(MIN_DEPTH + 0.6, MAX_DEPTH - 0.7))
        return np.array([side * self.rng.uniform(0.0, 0.85) * float(self._camera.half_width(depth)), depth])

    def frames(self, low: float, high: float) -> float:
        """Draw a time between `low` and `high` seconds, log-uniform, as a whole number of frames."""
        return float(round(self.rate * low * (high / low) ** self.rng.random()))

    def pace(self) -> float:
        """Draw a desired speed, m/s."""
        return float(np.clip(1.1 + 0.33 * self.rng.standard_normal(), 0.4, 1.9))

    def offset(self) -> Array:
        """Draw the offset between two people who stay together, m."""
        angle = self.rng.uniform(0.0, 2.0 * math.pi)
        return _SPACING * np.array([math.cos(angle), math.sin(angle)])

    def plan(self, birth: int, start: Array, legs: list[list[float]], pace: float) -> Plan:
        """Return the plan of a new person, with random stature, outfit and wandering."""
        wander = self._body.uniform([0.0, 0.02, 0.0], [0.25, 0.07, 2.0 * math.pi])
        return Plan(
            birth,
            (float(start[0]), float(start[1])),
            np.array(legs),
            pace,
            float(np.clip(1.72 + 0.08 * self._body.standard_normal(), 1.55, 1.92)),
            int(self._body.integers(0, 2**62)),
            (float(wander[0]), float(wander[1]), float(wander[2])),
        )


def _together(lobby: _Lobby, birth: int, start: Array, stops: list[tuple[Array, float]], size: int) -> Party:
    """Return the plans of a party that stays together. Stops are places (m) and durations (frames)."""
    pace = lobby.pace()
    offsets = [np.zeros(2)] + [lobby.offset() * (1.0 + 0.5 * (k // 2)) for k in range(size - 1)]
    party = []
    for offset in offsets:
        legs = [leg(_inside(place + offset), pause, face=_angle(-offset)) for place, pause in stops]
        party.append(lobby.plan(birth, start + offset, legs, pace))
    return party


def _random_visit(lobby: _Lobby, birth: int) -> Party:
    kind = lobby.rng.random()
    if kind < 0.25:
        return _meeting(lobby, birth)
    size = 2 if lobby.chance(0.2) else 1
    enter = lobby.door()
    if kind < 0.35:
        stops = [(lobby.outside(lobby.door(enter[0])), 0.0)]
    else:
        stops = [(lobby.spot(enter[0]), lobby.frames(2.0, 12.0))]
        if lobby.chance(0.1):
            stops.append((lobby.spot(enter[0]), lobby.frames(1.0, 6.0)))
        stops.append((lobby.outside(lobby.door(-enter[0] if lobby.chance(0.9) else 0)), 0.0))
    return _together(lobby, birth, lobby.outside(enter), stops, size)


def _crossing_visit(lobby: _Lobby, birth: int) -> Party:
    """Return a visit that crosses the lobby to the other side, mostly to another depth."""
    enter = lobby.door()
    leave = lobby.outside(lobby.door(enter[0]))
    return _together(lobby, birth, lobby.outside(enter), [(leave, 0.0)], 2 if lobby.chance(0.2) else 1)


def _crowd_visit(lobby: _Lobby, birth: int) -> Party:
    kind = lobby.rng.random()
    if kind < 0.25:
        return _meeting(lobby, birth)
    size = 1 + int(lobby.rng.choice(3, p=(0.4, 0.4, 0.2)))
    enter = lobby.door()
    stops = [(lobby.spot(enter[0]), lobby.frames(2.0, 14.0))] if kind < 0.7 else []
    stops.append((lobby.outside(lobby.door(enter[0])), 0.0))
    return _together(lobby, birth, lobby.outside(enter), stops, size)


def _meeting(lobby: _Lobby, birth: int) -> Party:
    """Return a visit in which two people arrive separately, meet, stay, and leave together or separately."""
    doors = [lobby.door()]
    doors.append(lobby.door(doors[0][0] if lobby.chance(0.2) else -doors[0][0]))
    place, apart = lobby.spot(doors[0][0]), lobby.offset()
    starts = [lobby.outside(door) for door in doors]
    paces = [lobby.pace(), lobby.pace()]
    ways = [float(np.hypot(*(place - start))) / pace * lobby.rate for start, pace in zip(starts, paces, strict=True)]
    # The person with the longer way enters first, so that both arrive at about the same time.
    births = [birth + round(max(ways) - way) for way in ways]
    until = birth + max(ways) + lobby.frames(1.0, 7.0)
    exits = [lobby.outside(lobby.door(-door[0] if lobby.chance(0.9) else 0)) for door in doors]
    if lobby.chance(0.5):
        exits[1] = exits[0] + apart
        paces = [float(np.mean(paces))] * 2
    party = []
    for member, sign in enumerate((-0.5, 0.5)):
        stand = leg(_inside(place + sign * apart), until=until, face=_angle(-sign * apart))
        party.append(lobby.plan(births[member], starts[member], [stand, leg(exits[member])], paces[member]))
    return party


def _inside(place: Array) -> Array:
    """Return the place with its depth clipped to the walkable range."""
    return np.array([place[0], min(max(place[1], MIN_DEPTH), MAX_DEPTH)])


def _angle(direction: Array) -> float:
    """Return the angle of a direction on the floor, rad; NaN for the zero vector."""
    return math.atan2(direction[1], direction[0]) if np.any(direction) else math.nan


_VISITS: dict[str, Callable[[_Lobby, int], Party]] = {
    "random": _random_visit,
    "crossing": _crossing_visit,
    "crowd": _crowd_visit,
}
