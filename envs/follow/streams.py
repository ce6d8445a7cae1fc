"""Child streams of an episode's seed that belong to the crowd and to what detectors make of it."""

from __future__ import annotations

from enum import IntEnum


class FollowStream(IntEnum):
    """Numbers beside those of `servotrack.envs.servo.episode.Stream`; they must never change."""

    PERSON = 2000
    OTHERS = 2001
    LOOKS = 2002
    OCCLUDERS = 2003
    DETECTION_NOISE = 2004
    MISSES = 2005
    CLUTTER = 2006
    SHUFFLE = 2007
