"""Detections of one frame, in the form that all detectors return and all trackers accept."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array, Estimator
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


class Detections(NamedTuple):
    """Detections of one frame, k objects; pixel i spans i to i + 1.

    Attributes:
        boxes: Left, top, width and height. Shape (k, 4), px.
        centroids: Centroids of the object's pixels if the detector has a mask, else of the box. Shape (k, 2), px.
        areas: Number of the object's pixels if the detector has a mask, else of the box. Shape (k,), px.
        confidences: Confidences on the detector's own scale; 1 if it gives none. Shape (k,).
        features: Appearance vectors of unit length, so that the product of two is their similarity; F is 0 without
            appearance. Shape (k, F).
    """

    boxes: Array
    centroids: Array
    areas: Array
    confidences: Array
    features: Array


Detector: TypeAlias = Estimator[ArrayLike, Any, Detections]
"""Detector of objects in frames, with a state of its own type."""


def detections_from_boxes(boxes: ArrayLike, confidences: ArrayLike | None = None) -> Detections:
    """Detections with boxes and confidences only, as in files of public detections.

    Args:
        boxes: Left, top, width and height. Shape (k, 4), px; k may be 0.
        confidences: Confidences, shape (k,); None for 1.

    Raises:
        ValueError: The shape is wrong, values are not finite, or a width or height is negative.
    """
    array = np.array(as_numbers("boxes", boxes))
    if array.size == 0:
        array = array.reshape(0, 4)
    if array.ndim != 2 or array.shape[1] != 4:
        raise ValueError(f"boxes must have shape (k, 4), left, top, width, height, got {array.shape}")
    bad = ~(np.abs(array) <= LIMITS.boxes).all(axis=1) | (array[:, 2:] < 0.0).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"boxes must be finite, within {LIMITS.boxes:g} px, with width and height of at least 0, got "
            f"{array[row].tolist()} in row {row}; leave bad rows out"
        )
    count = len(array)
    given = np.ones(count) if confidences is None else np.array(as_numbers("confidences", confidences))
    if given.shape != (count,):
        raise ValueError(f"confidences must have shape ({count},), got {given.shape}; give one for each box")
    check_within("confidences", given, LIMITS.scores, "leave such boxes out")
    centroids = array[:, :2] + array[:, 2:] / 2.0
    return Detections(array, centroids, array[:, 2] * array[:, 3], given, np.zeros((count, 0)))
