"""Random streams of an episode's seed for the crowd and its detections."""

from __future__ import annotations

from enum import IntEnum


class FollowStream(IntEnum):
    """Stream numbers, distinct from those of `servotrack.envs.servo.episode.Stream`. They must never change."""

    PERSON = 2000
    OTHERS = 2001
    OUTFITS = 2002
    OCCLUDERS = 2003
    DETECTION_NOISE = 2004
    MISSES = 2005
    CLUTTER = 2006
    SHUFFLE = 2007
