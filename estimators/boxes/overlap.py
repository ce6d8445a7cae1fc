"""Share of a box that another box covers."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


def covered_by(boxes: Array, others: Array) -> Array:
    """Share of each box that each of the others covers.

    Args:
        boxes: Left, top, width, height. Shape (k, 4), px.
        others: Left, top, width, height. Shape (n, 4), px.

    Returns:
        Shape (k, n), from 0 to 1; 0 for boxes without an area.
    """
    return covered_boxes(np.ascontiguousarray(boxes, dtype=np.float64), np.ascontiguousarray(others, dtype=np.float64))


@njit(cache=True, nogil=True)
def covered_boxes(boxes, others):  # type: ignore[no-untyped-def]
    """Compute `covered_by` in compiled code; the arrays must be contiguous."""
    out = np.zeros((boxes.shape[0], others.shape[0]))
    for i in range(boxes.shape[0]):
        left, top, width, height = boxes[i]
        if width <= 0.0 or height <= 0.0:
            continue
        for j in range(others.shape[0]):
            wide = min(left + width, others[j, 0] + others[j, 2]) - max(left, others[j, 0])
            tall = min(top + height, others[j, 1] + others[j, 3]) - max(top, others[j, 1])
            if wide > 0.0 and tall > 0.0:
                out[i, j] = wide * tall / (width * height)
    return out
