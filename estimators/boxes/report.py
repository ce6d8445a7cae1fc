"""Contract of the trackers of boxes: the type, checks of their detections, and the form of their estimates."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import HELD, REPORTED, SetEstimate
from servotrack.estimators.types import Array, Estimator, Labels

BoxTracker: TypeAlias = Estimator[Detections, Any, SetEstimate]
"""Tracker of boxes, with a state of its own type; its estimates have states (left, top, width, height), px."""

LARGEST_HELD = 0.49
"""Upper limit of the existence of an identity that is held but not reported."""


def check_detections(detections: Detections, features: int | None = None) -> None:
    """Raise ValueError for detections that a tracker cannot use.

    Args:
        detections: Detections of one frame.
        features: Required length of an appearance vector; None for any.

    Raises:
        ValueError: Values are not finite, sizes are below 0, or appearance vectors have another length.
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
    """Covariances of (left, top, width, height) for independent centers and sizes.

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
    boxes: Array, covariances: Array, labels: Labels, existence: Array, report: float = REPORTED
) -> SetEstimate:
    """Split identities into reported and held ones.

    Args:
        boxes: Left, top, width, height. Shape (k, 4), px.
        covariances: Covariances of the boxes. Shape (k, 4, 4).
        labels: Identities. Shape (k,).
        existence: Probabilities of existence. Shape (k,).
        report: Existence from which an identity is reported. Raising it reports fewer.
    """
    shown = existence >= report
    held = ~shown & (existence >= HELD)
    return SetEstimate(
        boxes[shown],
        labels[shown],
        np.maximum(existence[shown], REPORTED),
        covariances[shown],
        np.asarray(existence.sum()),
        labels[held],
        boxes[held],
        np.minimum(existence[held], LARGEST_HELD),
    )
