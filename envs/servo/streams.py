"""Stream numbers of the random quantities of a servo episode."""

from __future__ import annotations

from enum import IntEnum


class Stream(IntEnum):
    """Stream numbers of an episode's seed. A new stream does not change the others; the numbers must never change."""

    LINKS = 0
    FOCAL = 1
    DEPTH = 2
    MOUNTING = 3
    PRINCIPAL_POINT = 4
    DISTORTION = 5
    TILT = 6
    ASPECT = 7
    TARGET = 8
    PIXEL_NOISE = 9
    OUTLIER = 10
    OUTLIER_OFFSET = 11
    DROPOUT = 12
    LATENCY = 13
    ACTUATION_NOISE = 14
    ACTUATION_GAIN = 15
    ENCODER_NOISE = 16
    DISTRACTOR = 17
    IMAGE_NOISE = 18
    FLOOR = 19
    ENCODER_AGE = 20
    OCCLUSION = 21
    KNOCK = 22
    ZOOM = 23
