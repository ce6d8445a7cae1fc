"""Who comes when and does what: the plans of a lobby's visitors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PedestrianConfig
from servotrack.envs.track.pedestrians.floor import FAR, NEAR, Camera
from servotrack.envs.track.pedestrians.paper_script import meet_split_third_guy
from servotrack.envs.track.pedestrians.scene import Party, Plan, Stream, leg
from servotrack.estimators.types import Array

OUTSIDE = 0.55
"""How far beyond the image's border people come and go, m."""
WARM_UP = 14.0
"""Time for which people come before anybody is shown, so that the lobby is populated then, s."""

_EVENNESS = 4.0
"""Shape of the gaps between arrivals; 1 would be Poisson's, with episodes that nobody or everybody visits."""

_RESIDENCE = {"random": 13.3, "crossing": 10.5, "crowd": 14.1}
"""Mean time in sight, s, as measured: with it `people` is the mean number."""
_PARTY_SIZE = {"random": 1.4, "crossing": 1.2, "crowd": 1.85}
"""Mean number of people of a party."""
_DOORS = ((-1, 7.4), (-1, 9.6), (-1, 13.0), (1, 7.4), (1, 9.6), (1, 13.0))
"""Side and depth (m) of where people come and go."""
_SPACING = 0.6
"""Between those who walk or stand together, m."""


def draw_parties(config: PedestrianConfig, camera: Camera, seed: int) -> tuple[list[Party], range]:
    """The parties that come in an episode, ordered by their first birth, and the frames to simulate.

    Args:
        config: The scene; its script is any but `replay`.
        camera: Which sees the lobby.
        seed: Of the episode.
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
    # Enough gaps to fill all but one episode in many billions.
    expected = rate * len(frames)
    gaps = arrivals.gamma(_EVENNESS, 1.0 / (_EVENNESS * rate), round(expected + 8.0 * math.sqrt(expected) + 16.0))
    births = begin + np.floor(np.cumsum(gaps)).astype(np.int64)
    visit = _VISITS[config.script]
    parties = []
    for number, birth in enumerate(births[births < frames.stop].tolist()):
        parties.append(visit(_Lobby(config, camera, streams, number), birth))
    parties.sort(key=lambda party: min(plan.birth for plan in party))
    return parties, frames


class _Lobby:
    """Draws what a party's plans are made of, from streams of its own."""

    def __init__(self, config: PedestrianConfig, camera: Camera, streams: Streams, number: int) -> None:
        self._camera = camera
        self.rate = config.frame_rate
        self.rng = streams[Stream.PARTY, number]
        self._body = streams[Stream.BODY, number]

    def chance(self, probability: float) -> bool:
        """Whether something of this probability happens."""
        return bool(self.rng.random() < probability)

    def door(self, but_side: int = 0) -> tuple[int, float]:
        """Side and depth of a door, not on the side `but_side`."""
        side, depth = _DOORS[int(self.rng.integers(len(_DOORS)))]
        return (-but_side if side == but_side else side), depth + float(self.rng.uniform(-0.9, 0.9))

    def outside(self, door: tuple[int, float]) -> Array:
        """The point of the floor beyond a door."""
        side, depth = door
        return np.array([side * (float(self._camera.half_width(depth)) + OUTSIDE), depth])

    def spot(self, side: int) -> Array:
        """A place in sight, mostly in one half of the image and not too close to its border."""
        depth = float(self.rng.uniform(NEAR + 0.6, FAR - 0.7))
        return np.array([side * self.rng.uniform(0.0, 0.85) * float(self._camera.half_width(depth)), depth])

    def frames(self, low: float, high: float) -> float:
        """A time between `low` and `high` seconds, evenly on a logarithmic scale, in whole frames."""
        return float(round(self.rate * low * (high / low) ** self.rng.random()))

    def pace(self) -> float:
        """A speed that somebody likes, m/s."""
        return float(np.clip(1.1 + 0.33 * self.rng.standard_normal(), 0.4, 1.9))

    def beside(self) -> Array:
        """From one to the other of two who keep together, m."""
        angle = self.rng.uniform(0.0, 2.0 * math.pi)
        return _SPACING * np.array([math.cos(angle), math.sin(angle)])

    def plan(self, birth: int, start: Array, legs: list[list[float]], pace: float) -> Plan:
        """A plan of somebody new."""
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
    """Plans of people who keep together: stops are places and how many frames they stay."""
    pace = lobby.pace()
    offsets = [np.zeros(2)] + [lobby.beside() * (1.0 + 0.5 * (k // 2)) for k in range(size - 1)]
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
    """Straight through, to the other side and mostly at another depth."""
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
    """Two come by different ways, meet, stay, and go on together or apart."""
    doors = [lobby.door()]
    doors.append(lobby.door(doors[0][0] if lobby.chance(0.2) else -doors[0][0]))
    place, apart = lobby.spot(doors[0][0]), lobby.beside()
    starts = [lobby.outside(door) for door in doors]
    paces = [lobby.pace(), lobby.pace()]
    ways = [float(np.hypot(*(place - start))) / pace * lobby.rate for start, pace in zip(starts, paces, strict=True)]
    # Who has the longer way comes first, so that nobody waits long.
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
    """A place no nearer and no farther than people walk."""
    return np.array([place[0], min(max(place[1], NEAR), FAR)])


def _angle(direction: Array) -> float:
    """Where a direction on the floor points, rad; NaN for none."""
    return math.atan2(direction[1], direction[0]) if np.any(direction) else math.nan


_VISITS: dict[str, Callable[[_Lobby, int], Party]] = {
    "random": _random_visit,
    "crossing": _crossing_visit,
    "crowd": _crowd_visit,
}
