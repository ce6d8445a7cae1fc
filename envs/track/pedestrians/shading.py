"""Shading of the floor by bodies: contact shadows under the feet, and cast shadows of lamps."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit

_CONTACT = 0.13  # share of the light blocked directly under a body
_CONTACT_RADIUS = 0.15  # radius of the contact shadow, body heights
_SHADOW_LENGTH = 0.62  # length of a cast shadow toward the camera, body heights
_BLUR = 0.09  # growth of the penumbra along the shadow, px per px


@njit(cache=True, nogil=True)
def contact_shade(image, x, y, height, slope):  # type: ignore[no-untyped-def]
    """Darken the floor under a body that stands at (x, y)."""
    across, along = _CONTACT_RADIUS * height, max(_CONTACT_RADIUS * height * slope, 1.0)
    for i in range(max(int(y - along), 0), min(int(y + along) + 1, image.shape[0])):
        v = (i + 0.5 - y) / along
        for j in range(max(int(x - across), 0), min(int(x + across) + 1, image.shape[1])):
            u = (j + 0.5 - x) / across
            near = 1.0 - u * u - v * v
            if near > 0.0:
                keep = 1.0 - _CONTACT * near
                for c in range(3):
                    image[i, j, c] = np.uint8(image[i, j, c] * keep + 0.5)


@njit(cache=True, nogil=True)
def cast_shadow(image, patch, left, top, x, y, height, slope, sun, opacity):  # type: ignore[no-untyped-def]
    """Darken the floor in the shadow of the silhouette in a patch, with light from behind the body.

    `sun` is the shift of the shadow to the right per height of the point that casts it.
    """
    rows, columns = patch.shape[0], patch.shape[1]
    fall = max(_SHADOW_LENGTH * slope, 0.05)
    taps = np.empty(5, np.int64)
    tall = y - top  # height of the highest point
    first, last = max(int(y), 0), min(int(y + tall * fall) + 2, image.shape[0])
    for i in range(first, last):
        up = (i + 0.5 - y) / fall
        row = math.floor(y - up) - top
        if row < 0 or row >= rows:
            continue
        shift = sun * up
        blur = 0.6 + _BLUR * up
        strength = opacity * (1.0 - 0.45 * min(up / height, 1.0))
        start = max(int(left + shift - 2.0 * blur), 0)
        stop = min(int(left + columns + shift + 2.0 * blur) + 1, image.shape[1])
        # Offsets of the five taps of the penumbra in the patch, relative to the image column.
        for tap in range(5):
            taps[tap] = math.floor(0.5 - shift - left + (tap - 2) * 0.75 * blur)
        for j in range(start, stop):
            cover = 0.0
            for tap in range(5):
                column = j + taps[tap]
                if 0 <= column < columns:
                    cover += patch[row, column, 3]
            if cover > 0.0:
                keep = 1.0 - strength * cover / 5.0
                for c in range(3):
                    image[i, j, c] = np.uint8(image[i, j, c] * keep + 0.5)
