"""What a detector found in one frame: the one form in which detectors hand their findings to trackers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array


class Detections(NamedTuple):
    """What was found in one frame, k objects; pixel i spans i to i + 1.

    Attributes:
        boxes: Left, top, width and height. Shape (k, 4), px.
        centroids: Of the object's pixels where a detector has a mask, else of the box. Shape (k, 2), px.
        areas: Number of the object's pixels, else of the box. Shape (k,), px.
        confidences: As the detector gives them, on a scale of its own; 1 where it gives none. Shape (k,).
        features: Appearance, rows of unit length, so that a product of two is their similarity; F is 0 where there is
            none. Shape (k, F).
    """

    boxes: Array
    centroids: Array
    areas: Array
    confidences: Array
    features: Array


def detections_from_boxes(boxes: ArrayLike, confidences: ArrayLike | None = None) -> Detections:
    """Detections of which only boxes are known, as files of public detections hold them.

    Args:
        boxes: Left, top, width and height. Shape (k, 4), px; k may be 0.
        confidences: Shape (k,); None for 1.

    Raises:
        ValueError: Another shape, values that are not finite, or a negative width or height.
    """
    array = np.array(boxes, dtype=np.float64)
    if array.size == 0:
        array = array.reshape(0, 4)
    if array.ndim != 2 or array.shape[1] != 4:
        raise ValueError(f"boxes must have shape (k, 4), left, top, width, height, got {array.shape}")
    if not np.isfinite(array).all() or (array[:, 2:] < 0.0).any():
        raise ValueError("boxes must be finite with width and height of at least 0; leave bad rows out")
    count = len(array)
    given = np.ones(count) if confidences is None else np.array(confidences, dtype=np.float64)
    if given.shape != (count,) or not np.isfinite(given).all():
        raise ValueError(f"confidences must be finite with shape ({count},), got {given.shape}")
    centroids = array[:, :2] + array[:, 2:] / 2.0
    return Detections(array, centroids, array[:, 2] * array[:, 3], given, np.zeros((count, 0)))
