"""Exposure that changes faster than a background learns: one gain and one offset for the whole picture.

Automatic exposure and clouds change all gray levels by about the same line. Most of the picture is background, so the
medians of its darker and of its brighter half in frame and background are two points of that line. It is believed only
if it explains the change: a light that goes on in a part of the scene has no such line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Image


class ExposureRules(NamedTuple):
    """Conditions under which the background follows the exposure of the frames.

    Attributes:
        least: Smallest median change of the gray levels that is followed, gray levels. Raising it leaves more to the
            learning rate.
        changed: Smallest share of the picture that has changed by half of the threshold of foreground.
        explained: Largest share of these pixels that may still be changed along the line. Raising it follows changes
            that are no exposure, too.
        correlation: Smallest correlation of frame and background over the other pixels: another picture, as after a
            cut, has none. Raising it follows fewer changes of scenes without texture.
        contrast: Smallest distance of the two medians of the background; below it the gain is 1, gray levels.
        darkest: Gray level below which a pixel says nothing.
        usable: Smallest share of the picture that is neither too dark nor saturated, of the frame or the background.
        stride: Distance of the sampled pixels, px.
    """

    least: float = 8.0
    changed: float = 0.05
    explained: float = 0.5
    correlation: float = 0.7
    contrast: float = 10.0
    darkest: float = 45.0
    usable: float = 0.5
    stride: int = 7


def exposure_line(image: Image, background: Image, threshold: float, rules: ExposureRules) -> tuple[float, float]:
    """Return gain and offset, gray levels, of the exposure since the background was learned; 1 and 0 without a change.

    Args:
        image: The frame. Shape (H, W, 3) or (H, W), uint8.
        background: The background. The same shape, uint8.
        threshold: Difference from which a pixel is foreground, gray levels.
        rules: Conditions.
    """
    flat = (*image.shape[:2], -1)
    gain, offset = _line(image.reshape(flat), background.reshape(flat), threshold, rules)
    return float(gain), float(offset)


@njit(cache=True, nogil=True)
def _line(image, background, threshold, rules):  # type: ignore[no-untyped-def]
    rows, columns, channels = image.shape
    most = (rows // rules.stride + 1) * (columns // rules.stride + 1)
    seen, known, count, total = np.empty(most), np.empty(most), 0, 0
    half, before, brighter, darker = 0.5 * threshold, 0, 0, 0
    for row in range(0, rows, rules.stride):
        for column in range(0, columns, rules.stride):
            total += 1
            one, two, largest = 0.0, 0.0, 0
            for channel in range(channels):
                one += image[row, column, channel]
                two += background[row, column, channel]
                largest = max(largest, image[row, column, channel], background[row, column, channel])
            one, two = one / channels, two / channels
            # A saturated pixel says nothing on the exposure.
            if min(one, two) < rules.darkest or largest >= 250:
                continue
            seen[count], known[count] = one, two
            before += abs(one - two) > half
            brighter += one - two >= rules.least
            darker += two - one >= rules.least
            count += 1
    if before <= rules.changed * count or count < rules.usable * total:
        return 1.0, 0.0
    # Counts rule out most medians without sorting.
    if max(brighter, darker) < count // 2:
        return 1.0, 0.0
    seen, known = seen[:count], known[:count]
    if abs(np.median(seen - known)) < rules.least:
        return 1.0, 0.0
    bright = known > np.median(known)
    if not bright.any():
        return 1.0, 0.0
    low, high = np.median(known[~bright]), np.median(known[bright])
    seen_low, seen_high = np.median(seen[~bright]), np.median(seen[bright])
    gain = (seen_high - seen_low) / (high - low) if high - low >= rules.contrast else 1.0
    offset = 0.5 * (seen_low + seen_high - gain * (low + high))
    after, n = 0, 0.0
    sx = sy = sxx = syy = sxy = 0.0
    for k in range(count):
        x, y = known[k], seen[k]
        if abs(y - gain * x - offset) > half:
            after += 1
            continue
        n += 1.0
        sx += x
        sy += y
        sxx += x * x
        syy += y * y
        sxy += x * y
    if gain <= 0.0 or after > rules.explained * before:
        return 1.0, 0.0
    common, spread = sxy - sx * sy / n, math.sqrt((sxx - sx * sx / n) * (syy - sy * sy / n))
    return (gain, offset) if common > rules.correlation * spread else (1.0, 0.0)
