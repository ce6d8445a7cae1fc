"""What all trackers of boxes share: checks of what comes in, and the form of what goes out."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import HELD, SetEstimate
from servotrack.estimators.types import Array, Labels


def check_detections(detections: Detections, features: int | None = None) -> None:
    """Raise where detections are not what a tracker can use.

    Args:
        detections: What a detector found.
        features: Wanted numbers of an appearance; None for any.

    Raises:
        ValueError: Values that are not finite, sizes below 0, or appearances of another size.
    """
    boxes = detections.boxes
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ValueError(f"detections.boxes must have shape (k, 4), got {boxes.shape}")
    if not (np.isfinite(boxes).all() and np.isfinite(detections.confidences).all()):
        raise ValueError("detections must be finite; leave bad rows out")
    if len(boxes) and boxes[:, 2:].min() < 0.0:
        raise ValueError(f"detections.boxes must have sizes of at least 0, got {boxes[:, 2:].min()}")
    if features is not None and detections.features.shape[1] != features:
        raise ValueError(
            f"detections.features must have {features} numbers each as in the first frame, got "
            f"{detections.features.shape[1]}"
        )


def box_covariances(position: Array, size: Array) -> Array:
    """Covariances of (left, top, width, height) where centers and sizes are independent.

    Args:
        position: Variances of the center. Shape (k, 2).
        size: Variances of width and height. Shape (k, 2).

    Returns:
        Shape (k, 4, 4).
    """
    out = np.zeros((len(position), 4, 4))
    for axis in (0, 1):
        out[:, axis, axis] = position[:, axis] + size[:, axis] / 4.0
        out[:, axis, 2 + axis] = out[:, 2 + axis, axis] = -size[:, axis] / 2.0
        out[:, 2 + axis, 2 + axis] = size[:, axis]
    return out


def set_of_boxes(
    boxes: Array, covariances: Array, labels: Labels, existence: Array, report: float = 0.5
) -> SetEstimate:
    """Split identities into those reported and those held silently.

    Args:
        boxes: Left, top, width, height. Shape (k, 4), px.
        covariances: Shape (k, 4, 4).
        labels: Shape (k,).
        existence: Shape (k,).
        report: Existence from which an identity is reported.
    """
    shown = existence >= report
    held = ~shown & (existence >= HELD)
    return SetEstimate(
        boxes[shown],
        labels[shown],
        np.maximum(existence[shown], 0.5),
        covariances[shown],
        np.asarray(existence.sum()),
        labels[held],
        boxes[held],
        np.minimum(existence[held], 0.49),
    )
