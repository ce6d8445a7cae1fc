"""Base distances between the members of two sets: points, boxes, centroids, angles."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array
from servotrack.estimators.validation import as_numbers


def point_distances(first: ArrayLike, second: ArrayLike) -> Array:
    """Euclidean distances.

    Args:
        first: Points, shape (*batch, n, d).
        second: Points, shape (*batch, k, d).

    Returns:
        Distances, shape (*batch, n, k), in the points' unit.

    Raises:
        ValueError: The points differ in dimension.
    """
    a, b = _pair(first, second)
    return _in_batch(_point_distances, a, b)


def box_distances(first: ArrayLike, second: ArrayLike) -> Array:
    """One minus intersection over union of boxes (left, top, width, height).

    Args:
        first: Boxes, shape (*batch, n, 4), px.
        second: Boxes, shape (*batch, k, 4), px.

    Returns:
        Distances, shape (*batch, n, k), from 0 (equal) to 1 (disjoint). Boxes without area have distance 1 to all.

    Raises:
        ValueError: Boxes do not have four numbers.
    """
    a, b = _pair(first, second)
    if a.shape[-1] != 4:
        raise ValueError(f"boxes must be (left, top, width, height), got {a.shape[-1]} numbers each")
    return _in_batch(_box_distances, a, b)


def centroid_distances(first: ArrayLike, second: ArrayLike) -> Array:
    """Distances between the centers of boxes (left, top, width, height), in heights of the first ones.

    Use it for motion blobs, whose outline seldom equals the person's: their position is comparable, their overlap is
    not.

    Args:
        first: True boxes, shape (*batch, n, 4), px.
        second: Estimated boxes, shape (*batch, k, 4), px.

    Returns:
        Distances, shape (*batch, n, k). Infinite for a true box without height.

    Raises:
        ValueError: Boxes do not have four numbers.
    """
    a, b = _pair(first, second)
    if a.shape[-1] != 4:
        raise ValueError(f"boxes must be (left, top, width, height), got {a.shape[-1]} numbers each")
    apart = point_distances(a[..., :2] + a[..., 2:] / 2.0, b[..., :2] + b[..., 2:] / 2.0)
    height = np.broadcast_to(a[..., :, None, 3], apart.shape)
    return np.divide(apart, height, out=np.full_like(apart, np.inf), where=height > 0.0)


def wrapped_distances(first: ArrayLike, second: ArrayLike, period: float) -> Array:
    """Distances on a circle, for bearings.

    Args:
        first: Angles, shape (*batch, n, 1).
        second: Angles, shape (*batch, k, 1).
        period: Length of the circle, in the values' unit (360 for degrees).

    Returns:
        Distances, shape (*batch, n, k), from 0 to `period` / 2.

    Raises:
        ValueError: Members have more than one number, or the period is not positive.
    """
    a, b = _pair(first, second)
    if a.shape[-1] != 1:
        raise ValueError(f"bearings must be one number each, got {a.shape[-1]}")
    if not period > 0.0:
        raise ValueError(f"period must be positive, got {period!r}")
    gap = np.abs(a[..., :, None, 0] - b[..., None, :, 0]) % period
    return np.minimum(gap, period - gap)


def _pair(first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    a, b = as_numbers("first", first), as_numbers("second", second)
    if a.ndim < 2 or b.ndim < 2:
        raise ValueError(
            f"first and second must have shapes (*batch, n, d) and (*batch, k, d), got {a.shape} and {b.shape}; "
            "an empty set has shape (0, d)"
        )
    if a.shape[-1] != b.shape[-1]:
        raise ValueError(f"first and second must have members of one dimension, got {a.shape[-1]} and {b.shape[-1]}")
    return a, b


def _in_batch(kernel: Callable[[Array, Array, Array], None], a: Array, b: Array) -> Array:
    """Distances (*batch, n, k) by a kernel that fills (rows, n, k)."""
    batch = a.shape[:-2] if a.shape[:-2] == b.shape[:-2] else np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    out = np.empty((*batch, a.shape[-2], b.shape[-2]))
    kernel(_stacked(a, batch), _stacked(b, batch), _stacked(out, batch))
    return out


def _stacked(values: Array, batch: tuple[int, ...]) -> Array:
    """Reshape values (*batch, n, k) to (rows, n, k); a view unless broadcasting is needed."""
    whole = values if values.shape[:-2] == batch else np.broadcast_to(values, (*batch, *values.shape[-2:]))
    return np.ascontiguousarray(whole).reshape(math.prod(batch), *values.shape[-2:])


@njit(cache=True, nogil=True)
def _point_distances(first, second, out):  # type: ignore[no-untyped-def]
    rows, n, k = out.shape
    for row in range(rows):
        for i in range(n):
            for j in range(k):
                total = 0.0
                for axis in range(first.shape[2]):
                    total += (first[row, i, axis] - second[row, j, axis]) ** 2
                out[row, i, j] = math.sqrt(total)


@njit(cache=True, nogil=True)
def _box_distances(first, second, out):  # type: ignore[no-untyped-def]
    # NumPy's maximum and minimum propagate NaN, so a box with NaN has distance 1 to all.
    for row in range(len(out)):
        for i in range(out.shape[1]):
            a = first[row, i]
            for j in range(out.shape[2]):
                b = second[row, j]
                wide = np.minimum(a[0] + a[2], b[0] + b[2]) - np.maximum(a[0], b[0])
                high = np.minimum(a[1] + a[3], b[1] + b[3]) - np.maximum(a[1], b[1])
                overlap = np.maximum(wide, 0.0) * np.maximum(high, 0.0)
                union = a[2] * a[3] + b[2] * b[3] - overlap
                out[row, i, j] = 1.0 - overlap / union if union > 0.0 else 1.0
