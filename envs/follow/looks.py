"""What people, umbrellas and lampshades look like from above, and what a detector makes of their colors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.crowd import Crowd
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.looks import HAIR, TOP, compose_look
from servotrack.estimators.types import Array, Mask

BODY_WIDTH = 0.5
"""Of a person from above, m."""
UMBRELLA_RADIUS = 0.6
"""m."""
_UMBRELLAS = ((150, 34, 40), (34, 70, 120), (30, 32, 38), (196, 160, 60), (40, 96, 84))
_LAMP_RADIUS = (0.3, 0.5)  # m
_CLEAR_START, _WALKS = 60, 0.3  # samples before a lampshade may be met; speed of who walks, m/s
_COVERED = 0.12  # somebody's middle has to lie this far inside a shade to be hidden, m
_NO_BACKGROUND = np.zeros((1, 3))
_TOP_SHARE = 0.72  # of a person's picture from above; the rest is hair


class Looks(NamedTuple):
    """How everybody and everything that hangs over them looks in one episode.

    Attributes:
        people: Rows as `servotrack.envs.track.pedestrians.looks` names them. Shape (P, LOOK_NUMBERS).
        umbrella: Radius, 0 for none. Shape (P,), m.
        umbrella_color: Shape (P, 3), gray levels.
        lamps: Position and radius of each shade, shape (L, 3), m.
        colors: What a detector sees of each person on average. Shape (P, 3), gray levels.
        sizes: Diameter of what it sees, shape (P,), m.
    """

    people: Array
    umbrella: Array
    umbrella_color: Array
    lamps: Array
    colors: Array
    sizes: Array


def draw_looks(config: FollowConfig, streams: Streams, crowd: Crowd) -> Looks:
    """Draw everybody's looks, umbrellas and lamps; lamps hang over the way of the person to follow.

    Args:
        config: The world.
        streams: Of the episode.
        crowd: Where people walk.
    """
    rng = streams[FollowStream.LOOKS]
    alike = rng.random(config.people) < config.look_alikes
    # One generator for all: making one for everybody would take longer than all the rest.
    people = np.array([compose_look(rng, rng, rng, 0.0, _NO_BACKGROUND) for _ in range(config.people)])
    people[alike] = people[0]
    rng = streams[FollowStream.OCCLUDERS]
    umbrella, umbrella_color = np.zeros(config.people), np.zeros((config.people, 3))
    # The last ones carry them: who walks with the person to follow does not, if it can be helped.
    umbrella[config.people - config.umbrellas :] = UMBRELLA_RADIUS
    umbrella_color[:] = np.array(_UMBRELLAS, dtype=np.float64)[rng.integers(0, len(_UMBRELLAS), config.people)]
    lamps = _hang_lamps(config.lamps, rng, crowd.paths[:, 0]) if config.lamps else np.zeros((0, 3))
    bare = _TOP_SHARE * people[:, TOP : TOP + 3] + (1.0 - _TOP_SHARE) * people[:, HAIR : HAIR + 3]
    under = umbrella[:, None] > 0.0
    return Looks(
        people,
        umbrella,
        umbrella_color,
        lamps,
        np.where(under, umbrella_color, bare),
        np.where(umbrella > 0.0, 2.0 * umbrella, BODY_WIDTH),
    )


def _hang_lamps(count: int, rng: np.random.Generator, path: Array) -> Array:
    """Lampshades over a path (K, 4), as `Looks.lamps`."""
    speed = np.hypot(path[:, 2], path[:, 3])
    # Where the person walks: who rests under a lampshade cannot be found by anybody.
    walking = np.flatnonzero(speed[_CLEAR_START:] > _WALKS) + _CLEAR_START
    at = rng.choice(walking, count) if len(walking) else np.zeros(count, np.int64)
    return np.concatenate([path[at, :2], rng.uniform(*_LAMP_RADIUS, (count, 1))], axis=1)


def hidden_people(crowd: Crowd, looks: Looks) -> Mask:
    """Who is under a lampshade or under somebody else's umbrella, shape (K, P)."""
    places = crowd.paths[:, :, :2]
    hidden = np.zeros(places.shape[:2], np.bool_)
    for x, y, radius in looks.lamps.tolist():
        hidden |= np.hypot(places[..., 0] - x, places[..., 1] - y) < radius - _COVERED
    for carrier in np.flatnonzero(looks.umbrella > 0.0).tolist():
        off = places - places[:, carrier : carrier + 1]
        covered = np.hypot(off[..., 0], off[..., 1]) < looks.umbrella[carrier] - _COVERED
        covered[:, carrier] = False
        hidden |= covered
    return hidden
