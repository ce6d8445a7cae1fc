"""Random clothes, umbrellas and lampshades of an episode, their colors for a detector, and who they hide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.crowd import Crowd
from servotrack.envs.follow.streams import FollowStream
from servotrack.envs.streams import Streams, draw_share, start_stream
from servotrack.envs.track.pedestrians.outfits import HAIR, OUTFIT_NUMBERS, TOP, compose_outfit
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Mask

BODY_WIDTH = 0.5
"""Width of a person seen from above, m."""
UMBRELLA_RADIUS = 0.6
"""Radius of an umbrella, m."""
_UMBRELLAS = ((150, 34, 40), (34, 70, 120), (30, 32, 38), (196, 160, 60), (40, 96, 84))
_LAMP_RADIUS = (0.3, 0.5)  # m
_LAMP_FREE_SAMPLES = 60  # at the start of an episode, in which no lampshade is on the person's way
_WALKING_SPEED = 0.3  # from which on a person counts as walking, m/s
_HIDING_MARGIN = 0.12  # a person is hidden if their center lies at least this far inside a shade's edge, m
_NO_BACKGROUND = np.zeros((1, 3))
_TOP_SHARE = 0.72  # of a person's picture from above; the rest is hair


class Outfits(NamedTuple):
    """Appearance of all people of one episode, and of the umbrellas and lampshades above them.

    Attributes:
        people: Appearance vector of each person, columns as in `servotrack.envs.track.pedestrians.outfits`.
            Shape (P, OUTFIT_NUMBERS).
        umbrella: Radius of each person's umbrella, 0 without one. Shape (P,), m.
        umbrella_color: Color of each umbrella. Shape (P, 3), gray levels.
        lamps: Position and radius of each lampshade. Shape (L, 3), m.
        colors: Mean color of each person as a detector reports it. Shape (P, 3), gray levels.
        sizes: Diameter of each person as a detector reports it. Shape (P,), m.
    """

    people: Array
    umbrella: Array
    umbrella_color: Array
    lamps: Array
    colors: Array
    sizes: Array


def draw_outfits(config: FollowConfig, streams: Streams, crowd: Crowd) -> Outfits:
    """Draw the appearance of all people, the umbrellas and the lamps. Lamps hang over the target person's path.

    Args:
        config: Parameters of the world.
        streams: Random streams of the episode.
        crowd: Paths of the people.
    """
    people = np.zeros((config.people, OUTFIT_NUMBERS))
    _dress(streams.seed, config.look_alikes, people)
    rng = streams[FollowStream.OCCLUDERS]
    umbrella, umbrella_color = np.zeros(config.people), np.zeros((config.people, 3))
    # The last people carry umbrellas: companions, who come first, get one only if there are too few others.
    umbrella[config.people - config.umbrellas :] = UMBRELLA_RADIUS
    umbrella_color[:] = np.array(_UMBRELLAS, dtype=np.float64)[rng.integers(0, len(_UMBRELLAS), config.people)]
    lamps = _hang_lamps(config.lamps, rng, crowd.paths[:, 0]) if config.lamps else np.zeros((0, 3))
    bare = _TOP_SHARE * people[:, TOP : TOP + 3] + (1.0 - _TOP_SHARE) * people[:, HAIR : HAIR + 3]
    under = umbrella[:, None] > 0.0
    return Outfits(
        people,
        umbrella,
        umbrella_color,
        lamps,
        np.where(under, umbrella_color, bare),
        np.where(umbrella > 0.0, 2.0 * umbrella, BODY_WIDTH),
    )


@njit(cache=True, nogil=True)
def _dress(seed, look_alikes, people):  # type: ignore[no-untyped-def]
    """Draw the appearance of all people, (P, OUTFIT_NUMBERS), zeros before, from one stream."""
    state, alike = np.zeros(6, np.uint64), np.zeros(len(people), np.bool_)
    start_stream(seed, FollowStream.OUTFITS.value, state)
    for person in range(len(people)):
        alike[person] = draw_share(state) < look_alikes
    for person in range(len(people)):
        compose_outfit(state, state, state, 0.0, _NO_BACKGROUND, people[person])
    for person in range(len(people)):
        if alike[person]:
            people[person] = people[0]


def _hang_lamps(count: int, rng: np.random.Generator, path: Array) -> Array:
    """Hang lampshades over a path (K, 4). Returns rows like `Outfits.lamps`."""
    speed = np.hypot(path[:, 2], path[:, 3])
    # Only where the person walks: a person who rests under a lampshade could never be found.
    walking = np.flatnonzero(speed[_LAMP_FREE_SAMPLES:] > _WALKING_SPEED) + _LAMP_FREE_SAMPLES
    at = rng.choice(walking, count) if len(walking) else np.zeros(count, np.int64)
    return np.concatenate([path[at, :2], rng.uniform(*_LAMP_RADIUS, (count, 1))], axis=1)


def hidden_people(crowd: Crowd, outfits: Outfits) -> Mask:
    """Mask of the people under a lampshade or under another person's umbrella, shape (K, P)."""
    places = crowd.paths[:, :, :2]
    hidden = np.zeros(places.shape[:2], np.bool_)
    for x, y, radius in outfits.lamps.tolist():
        hidden |= np.hypot(places[..., 0] - x, places[..., 1] - y) < radius - _HIDING_MARGIN
    for carrier in np.flatnonzero(outfits.umbrella > 0.0).tolist():
        off = places - places[:, carrier : carrier + 1]
        covered = np.hypot(off[..., 0], off[..., 1]) < outfits.umbrella[carrier] - _HIDING_MARGIN
        covered[:, carrier] = False
        hidden |= covered
    return hidden
