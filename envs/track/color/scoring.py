"""Scores of single-object tracking: IoU, center error, success curve, precision, failures (one-pass evaluation)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array

SUCCESS_THRESHOLDS = np.linspace(0.0, 1.0, 21)
"""IoU thresholds of the success curve: 0, 0.05, ..., 1."""
PRECISION_DISTANCE = 20.0
"""Center error up to which a frame counts as precise, px."""


def overlaps(boxes: ArrayLike, others: ArrayLike) -> Array:
    """Return the intersection over union of pairs of boxes.

    Args:
        boxes: Left, top, width and height, shape (..., 4), px.
        others: Boxes of the same shape.

    Returns:
        IoU from 0 to 1, shape (...); 0 if a box has no area.
    """
    a, b = np.asarray(boxes, dtype=np.float64), np.asarray(others, dtype=np.float64)
    size = np.maximum(
        np.minimum(a[..., :2] + a[..., 2:], b[..., :2] + b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0
    )
    shared = size[..., 0] * size[..., 1]
    union = np.maximum(a[..., 2] * a[..., 3], 0.0) + np.maximum(b[..., 2] * b[..., 3], 0.0) - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0)


def center_errors(boxes: ArrayLike, others: ArrayLike) -> Array:
    """Return the distances between the centers of pairs of boxes, px; shapes as in `overlaps`."""
    a, b = np.asarray(boxes, dtype=np.float64), np.asarray(others, dtype=np.float64)
    apart = a[..., :2] + a[..., 2:] / 2.0 - b[..., :2] - b[..., 2:] / 2.0
    return np.hypot(apart[..., 0], apart[..., 1])


def success_curve(iou: ArrayLike) -> Array:
    """Return the share of frames whose IoU exceeds each of `SUCCESS_THRESHOLDS`.

    Source: Wu, Lim and Yang, "Object tracking benchmark", IEEE TPAMI 37(9), 2015, section 4.

    Args:
        iou: IoU of every frame, shape (frames,).

    Returns:
        Success rate at each threshold, shape (21,).
    """
    values = np.asarray(iou, dtype=np.float64)
    return (values[:, None] > SUCCESS_THRESHOLDS).mean(axis=0)


def precision(center_error: ArrayLike) -> float:
    """Return the share of frames with a center error of at most `PRECISION_DISTANCE`."""
    return float((np.asarray(center_error, dtype=np.float64) <= PRECISION_DISTANCE).mean())


def failures(iou: ArrayLike) -> int:
    """Return the number of runs of frames without overlap, of any length."""
    lost = np.concatenate([[False], np.asarray(iou, dtype=np.float64) <= 0.0])
    return int((lost[1:] & ~lost[:-1]).sum())
