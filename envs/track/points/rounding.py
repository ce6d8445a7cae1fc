"""Rounding of recorded coordinates, such as whole meters or fifth decimals of a degree, found from what targets do."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.types import Array

_SAME = 1e-9
"""Difference of coordinates that only the rounding of floating point numbers makes, as a share of the largest one."""
_EVEN, _EVEN_SHARE = 1e-3, 0.8
"""Departure from whole steps, in steps, and share of the differences that must have less."""
_UNEVEN_MOTION = 0.03
"""Least share of targets that seem to change their speed. Exact motion at a whole speed is not rounded."""


def rounding_noise(triples: Array) -> float:
    """Root mean square over the axes of the standard deviation that rounding gives a coordinate, m.

    Rounded to a step s, a coordinate has an error of s / sqrt(12). Steps show in differences of a target's coordinates:
    all are whole multiples of one number, and the speed seems to change. Axes where they do not count as exact.

    Args:
        triples: Three measurements in a row of one target each. Shape (k, 3, d), m.
    """
    d = triples.shape[2]
    steps = np.zeros(d)
    same = _SAME * float(np.abs(triples).max(initial=0.0))
    for axis in range(d):
        moves = np.abs(np.diff(triples[:, :, axis], axis=1))
        ordered = np.sort(moves[moves > same])
        # Two differences are equal to the last digit only where coordinates are rounded.
        again = ordered[1:][np.diff(ordered) <= same]
        if not len(again):
            continue
        step = float(again[0])
        even = np.abs(moves / step - np.round(moves / step)) < _EVEN
        uneven = np.abs(np.diff(triples[:, :, axis], n=2, axis=1)) > same
        if even.mean() >= _EVEN_SHARE and uneven[even.all(axis=1)].mean() >= _UNEVEN_MOTION:
            steps[axis] = step
    return float(np.sqrt(np.mean(steps**2) / 12.0))
