"""Extent of recorded points in space and time: their region, their usual step, and what is wrong with either."""

from __future__ import annotations

import numpy as np

from servotrack.envs.track.files.points import PointScans
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array

_MARGIN = 0.02
_CUTOFF_SHARE = 0.025
_RESOLUTION = 1e-9
"""Least side of the region as a share of the largest coordinate."""
_FAR, _MOST = 30.0, 0.95
"""Distance of a far point in distances within which this share of the points lies."""
_SMALLEST = 1e-15
"""Smallest usual time step, s, and extent of all points, m."""
_STEPS = (1e-6, 1e9)
"""Least time step and longest time of a file, in usual steps."""
_USUAL = 0.9
"""Quantile of the time steps that is the usual one: sensors that follow one another closely have many short steps."""


def period_of(points: PointScans) -> float:
    """Usual time between scans, s: nine of ten steps are at most as long."""
    return float(np.quantile(np.diff(points.times), _USUAL, method="lower"))


def side_of(points: PointScans) -> float:
    """Longest side of the bounds of all points, m; some width if they are all at one place."""
    low, high = bounds_of(points)
    return max(float((high - low).max()), _RESOLUTION * float(np.abs([low, high]).max())) or 1.0


def bounds_of(points: PointScans) -> tuple[Array, Array]:
    """Least and largest coordinates of all points. Shapes (d,), m."""
    everything = np.concatenate(points.scans)
    return everything.min(axis=0), everything.max(axis=0)


def region_of(points: PointScans) -> tuple[Array, Array]:
    """Corners of the bounds of all points with a margin. Shapes (d,)."""
    low, high = bounds_of(points)
    # A region without extent along an axis would have no volume.
    margin = np.maximum(_MARGIN * (high - low), 1e-3 * side_of(points))
    return low - margin, high + margin


def scores_cutoff(low: Array, high: Array) -> float:
    """Cut-off of scores in a region, m: a fortieth of its longest side."""
    return _CUTOFF_SHARE * float((high - low).max())


def check_scales(points: PointScans) -> None:
    """Raise a SequenceError if time steps or extent are so small, or differ so much, that rounding would decide."""
    steps, usual, side = np.diff(points.times), period_of(points), side_of(points)
    if min(usual, side) < _SMALLEST:
        raise SequenceError(
            f"the usual time step and the extent of all points must be at least {_SMALLEST:g}, got {usual:g} s and "
            f"{side:g} m; give seconds and meters"
        )
    if steps.min() < _STEPS[0] * usual:
        at = float(points.times[int(steps.argmin())])
        raise SequenceError(
            f"times must be at least {_STEPS[0]:g} of the usual step of {usual:g} s apart, got {steps.min():g} s "
            f"after time {at!r}; give the points of one scan one time"
        )
    span = points.times[-1] - points.times[0]
    if span > _STEPS[1] * usual:
        raise SequenceError(
            f"times must span at most {_STEPS[1]:g} usual steps, got {span:g} s and steps of {usual:g} s; split "
            "the file"
        )


def outlier_notes(points: PointScans) -> list[str]:
    """Return a note on points so far from the others that they make the region too large."""
    everything = np.concatenate(points.scans)
    middle = np.median(everything, axis=0)
    away = np.abs(everything - middle)
    usual = np.maximum(np.quantile(away, _MOST, axis=0), 1e-3 * side_of(points))
    far = (away > _FAR * usual).any(axis=1)
    if not far.any():
        return []
    return [
        f"{int(far.sum())} points are more than {_FAR:g} times as far out as {100 * _MOST:g} % of all and make the "
        "region large, so that much else looks like a target; leave them out if they are faults"
    ]
