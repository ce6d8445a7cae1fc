"""How boxes of one object are scored in one pass over a sequence, as the object tracking benchmarks do it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array

SUCCESS_THRESHOLDS = np.linspace(0.0, 1.0, 21)
"""Overlaps of the success curve: 0, 0.05, ..., 1."""
PRECISION_DISTANCE = 20.0
"""A center this near counts as precise, px."""


def overlaps(boxes: ArrayLike, others: ArrayLike) -> Array:
    """Intersection over union, box by box.

    Args:
        boxes: Left, top, width and height. Shape (..., 4), px.
        others: The same shape.

    Returns:
        0 to 1, 0 where a box has no area. Shape (...).
    """
    a, b = np.asarray(boxes, dtype=np.float64), np.asarray(others, dtype=np.float64)
    size = np.maximum(
        np.minimum(a[..., :2] + a[..., 2:], b[..., :2] + b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0
    )
    shared = size[..., 0] * size[..., 1]
    union = np.maximum(a[..., 2] * a[..., 3], 0.0) + np.maximum(b[..., 2] * b[..., 3], 0.0) - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0)


def center_errors(boxes: ArrayLike, others: ArrayLike) -> Array:
    """Distances between the boxes' middles, px. Shapes as `overlaps`."""
    a, b = np.asarray(boxes, dtype=np.float64), np.asarray(others, dtype=np.float64)
    apart = a[..., :2] + a[..., 2:] / 2.0 - b[..., :2] - b[..., 2:] / 2.0
    return np.hypot(apart[..., 0], apart[..., 1])


def success_curve(iou: ArrayLike) -> Array:
    """Share of frames whose overlap exceeds each of `SUCCESS_THRESHOLDS`.

    Source: Wu, Lim and Yang, "Object tracking benchmark", IEEE TPAMI 37(9), 2015, section 4.

    Args:
        iou: Of every frame, shape (frames,).

    Returns:
        Shape (21,).
    """
    values = np.asarray(iou, dtype=np.float64)
    return (values[:, None] > SUCCESS_THRESHOLDS).mean(axis=0)


def precision(center_error: ArrayLike) -> float:
    """Share of frames whose center lies within `PRECISION_DISTANCE` of the true one."""
    return float((np.asarray(center_error, dtype=np.float64) <= PRECISION_DISTANCE).mean())


def failures(iou: ArrayLike) -> int:
    """How many times the target was lost: runs of frames without any overlap, whatever their length."""
    lost = np.concatenate([[False], np.asarray(iou, dtype=np.float64) <= 0.0])
    return int((lost[1:] & ~lost[:-1]).sum())
