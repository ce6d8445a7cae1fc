"""Script `meet_split_third_guy`, after the CAVIAR sequence of Wu and Hu 2010: two people meet and separate."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.pedestrians.config import PAPER_FRAMES, PedestrianConfig
from servotrack.envs.track.pedestrians.floor import Camera
from servotrack.envs.track.pedestrians.scene import Party, Plan, Stream, leg
from servotrack.estimators.types import Array

NUMBERS = (
    (0, 0), (49, 1), (169, 2), (319, 3), (518, 2), (624, 1), (699, 2), (749, 3), (755, 2), (899, 1),
)  # fmt: skip
"""Pairs of a frame and the number of people from this frame on."""
MERGE, SPLIT = 450, 468
"""Frames at which the regions of the two people who meet merge and split."""

_MEETING = (-1.15, 8.6)
"""Place of the meeting (x, z), m."""
_HALF_OFFSET = (0.11, 0.17)
"""Half the offset between the two people who meet, m."""
_JITTER = 0.25
"""Maximum random deviation of each coordinate of a place, m."""
_NO_WANDER = (0.0, 0.0, 0.0)
_RIGHT, _LEFT = 0.0, math.pi


def meet_split_third_guy(config: PedestrianConfig, camera: Camera, streams: Streams) -> list[Party]:
    """Return the plans of the five people. The first enters at frame 49, the last stays until the end.

    People appear half inside the image border, so that they are visible from the frame of the schedule on.

    Args:
        config: Parameters of the environment. A shorter horizon cuts the sequence.
        camera: Camera of the lobby.
        streams: Random streams of the episode.
    """
    rng = streams[Stream.PARTY]
    last = max(PAPER_FRAMES, config.horizon) + 1

    def near(x: float, z: float) -> Array:
        return np.array([x, z]) + rng.uniform(-_JITTER, _JITTER, 2)

    def border(side: int, z: float) -> Array:
        depth = z + float(rng.uniform(-_JITTER, _JITTER))
        return np.array([side * (float(camera.half_width(depth)) - 0.03), depth])

    meeting = np.array(_MEETING) + rng.uniform(-_JITTER, _JITTER, 2)
    sides = np.array(_HALF_OFFSET)
    first = (
        49,
        518,
        border(-1, 9.2),
        [
            leg(near(0.6, 11.0), until=250.0, due=150.0, face=-1.2),
            leg(near(-2.9, 8.6), until=412.0, due=345.0, face=_RIGHT),
            leg(meeting - sides, until=457.0, due=452.0, face=_RIGHT),
            leg(border(-1, 8.4), until=518.0, due=519.0),
        ],
    )
    second = (
        169,
        624,
        border(1, 8.0),
        [
            leg(near(2.4, 9.3), until=355.0, due=245.0, face=_LEFT),
            leg(near(0.6, 8.6), until=412.0, due=400.0, face=_LEFT),
            leg(meeting + sides, until=457.0, due=452.0, face=_LEFT),
            leg(near(1.2, 7.6), until=560.0, due=530.0, face=-1.6),
            leg(border(1, 7.4), until=624.0, due=625.0),
        ],
    )
    third = (
        319,
        755,
        border(1, 12.6),
        [leg(near(2.2, 12.8), until=665.0, due=420.0, face=-2.0), leg(border(1, 12.4), until=755.0, due=756.0)],
    )
    fourth = (
        699,
        899,
        border(-1, 10.2),
        [leg(near(-1.0, 10.6), until=815.0, due=775.0, face=-1.0), leg(border(-1, 9.8), until=899.0, due=900.0)],
    )
    fifth = (749, last, border(1, 7.6), [leg(near(1.6, 8.4), until=float(last), due=815.0, face=_LEFT)])
    body = streams[Stream.BODY]
    parties: list[Party] = []
    # The two people who meet form one party, whose members keep less distance.
    for people in ((first, second), (third,), (fourth,), (fifth,)):
        party = []
        for birth, death, start, legs in people:
            stature = float(np.clip(1.74 + 0.07 * body.standard_normal(), 1.58, 1.9))
            outfit_seed = int(body.integers(0, 2**62))
            party.append(
                Plan(
                    birth,
                    (float(start[0]), float(start[1])),
                    np.array(legs),
                    0.8,
                    stature,
                    outfit_seed,
                    _NO_WANDER,
                    death,
                )
            )
        parties.append(party)
    return parties
