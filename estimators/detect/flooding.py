"""Floods: the foreground covers more than people can, because the light or the scene has changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.detect.difference import difference_of, rounded, share_above
from servotrack.estimators.types import FloatArray, Image


class FloodRules(NamedTuple):
    """Conditions under which a background returns or is replaced.

    Attributes:
        steady: Change of the mean brightness from which the light still changes, gray levels. Raising it replaces the
            background in the middle of a slower fade.
        dark: Brightness relative to that of the background below which a frame is dark: then light is not healed, and
            the background is kept for `memory`, because a dark picture says nothing on what is light again.
        settle: Time of steady light after a flood in which nothing is reported yet, s: a fade floods again and again.
        memory: Time of steady light after a flood for which the background before it may return, s.
        returns: Share of foreground against that background below which it is back, relative to the share of a flood.
        stride: Distance of the sampled pixels, px.
    """

    steady: float = 8.0
    dark: float = 0.3
    settle: float = 0.4
    memory: float = 10.0
    returns: float = 0.5
    stride: int = 7


class Flood(NamedTuple):
    """Memory of a flood.

    Attributes:
        passed: Time for which the foreground has covered too much of the image, s; 0 without a flood.
        steady: The part of it in which the light has not changed, s.
        light: Mean gray level since then.
        dark: True while the frames are much darker than the background.
        calm: Time of steady light since the last flood, s.
        reserve: Background before the last floods; None without one in `FloodRules.memory`.
    """

    passed: float = 0.0
    steady: float = 0.0
    light: float = 0.0
    dark: bool = False
    calm: float = 0.0
    reserve: FloatArray | None = None


def follow_flood(
    flood: Flood, image: Image, background: FloatArray, flooded: bool, dt: float, rules: FloodRules
) -> Flood:
    """Measure the time of a flood, and keep the background from before it.

    Args:
        flood: Memory so far.
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        background: Background before the frame, with its shape, float32.
        flooded: True if the foreground covers too much.
        dt: Time since the last frame, s.
        rules: Conditions.
    """
    if not flooded:
        if flood.reserve is None:
            return Flood() if flood.passed else flood
        light = float(np.mean(image[:: rules.stride, :: rules.stride]))
        if abs(light - flood.light) > rules.steady:
            return Flood(light=light, reserve=flood.reserve)
        calm = flood.calm + dt
        return Flood() if calm > rules.memory else Flood(light=flood.light, calm=calm, reserve=flood.reserve)
    sample = (slice(None, None, rules.stride),) * 2
    light = float(np.mean(image[sample]))
    dark = light < rules.dark * float(np.mean(background[sample]))
    reserve = background if flood.reserve is None else flood.reserve
    if flood.passed and abs(light - flood.light) <= rules.steady:
        return Flood(flood.passed + dt, flood.steady + dt, flood.light, dark, 0.0, reserve)
    return Flood(flood.passed + dt, dt, light, dark, 0.0, reserve)


def unsettled(flood: Flood, rules: FloodRules) -> bool:
    """Return True during a flood, and after it until the light has been steady for a short time."""
    return flood.passed > 0.0 or (flood.reserve is not None and flood.calm < rules.settle)


def returned(
    flood: Flood, image: Image, difference: Image, color: str, threshold: float, share: float, rules: FloodRules
) -> bool:
    """Return True if a frame shows the background before a flood again, better than the present one.

    Args:
        flood: Memory.
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        difference: Difference of the frame to the present background. Shape (H, W), uint8.
        color: Difference of a pixel, see `difference_of`.
        threshold: Difference from which a pixel is foreground, gray levels.
        share: Share of foreground of a flood.
        rules: Conditions.
    """
    if flood.reserve is None:
        return False
    before = difference_of(image, rounded(flood.reserve), color)
    most = min(rules.returns * share, share_above(difference, threshold, rules.stride))
    return bool(share_above(before, threshold, rules.stride) < most)
