"""Contract of the trackers of boxes: the type, checks of their detections, and the form of their estimates."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import HELD, REPORTED, SetEstimate
from servotrack.estimators.types import Array, Estimator, Labels
from servotrack.estimators.validation import LIMITS, as_numbers, check_within

BoxTracker: TypeAlias = Estimator[Detections, Any, SetEstimate]
"""Tracker of boxes, with a state of its own type; its estimates have states (left, top, width, height), px."""

LARGEST_HELD = 0.49
"""Upper limit of the existence of an identity that is held but not reported."""


def checked_detections(detections: Detections, features: int | None = None) -> Detections:
    """Check detections and convert them to float64 arrays: the front door of the trackers of boxes.

    Args:
        detections: Detections of one frame, array-likes.
        features: Required length of an appearance vector; None for any.

    Returns:
        The same values as arrays in C order.

    Raises:
        ValueError: A field is not numeric or has another shape, a value is not finite or beyond
            `servotrack.estimators.validation.LIMITS`, or a size is below 0.
    """
    boxes = as_numbers("detections.boxes", detections.boxes)
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ValueError(
            f"detections.boxes must have shape (k, 4), left, top, width, height, got {boxes.shape}; without detections "
            "pass shape (0, 4)"
        )
    count = len(boxes)
    appearance = as_numbers("detections.features", detections.features)
    if appearance.ndim != 2 or len(appearance) != count:
        raise ValueError(
            f"detections.features must have shape ({count}, F), one row per box, got {appearance.shape}; pass shape "
            f"({count}, 0) without appearance"
        )
    if features is not None and appearance.shape[1] != features:
        raise ValueError(
            f"detections.features must have {features} numbers each as in the first frame, got {appearance.shape[1]}; "
            "start again with initial(detections) to change it"
        )
    centroids = as_numbers("detections.centroids", detections.centroids)
    areas = as_numbers("detections.areas", detections.areas)
    confidences = as_numbers("detections.confidences", detections.confidences)
    for name, array, shape in (
        ("centroids", centroids, (count, 2)),
        ("areas", areas, (count,)),
        ("confidences", confidences, (count,)),
    ):
        if array.shape != shape:
            raise ValueError(
                f"detections.{name} must have shape {shape}, one entry per box, got {array.shape}; see "
                "detections_from_boxes"
            )
    remedy = "leave bad rows out"
    check_within("detections.boxes", boxes, LIMITS.boxes, remedy)
    check_within("detections.centroids", centroids, 2.0 * LIMITS.boxes, remedy)
    check_within("detections.areas", areas, LIMITS.boxes**2, remedy)
    check_within("detections.confidences", confidences, LIMITS.scores, remedy)
    check_within("detections.features", appearance, LIMITS.scores, "pass zeros for an unknown appearance")
    if count and boxes[:, 2:].min() < 0.0:
        raise ValueError(
            f"detections.boxes must have sizes of at least 0, got {boxes[:, 2:].min()}; pass width and height, not the "
            "second corner"
        )
    return Detections(boxes, centroids, areas, confidences, appearance)


@njit(cache=True, nogil=True)
def box_covariances(position, size):  # type: ignore[no-untyped-def]
    """Covariances of (left, top, width, height) for independent centers and sizes.

    Args:
        position: Variances of the center. Shape (k, 2).
        size: Variances of width and height. Shape (k, 2).

    Returns:
        Shape (k, 4, 4).
    """
    out = np.zeros((len(position), 4, 4))
    for k in range(len(position)):
        for axis in range(2):
            out[k, axis, axis] = position[k, axis] + size[k, axis] / 4.0
            out[k, axis, 2 + axis] = out[k, 2 + axis, axis] = -size[k, axis] / 2.0
            out[k, 2 + axis, 2 + axis] = size[k, axis]
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
    states, names, chances, spread, held, held_states, held_chances = _divided(
        boxes, covariances, labels, existence, report
    )
    return SetEstimate(states, names, chances, spread, np.asarray(existence.sum()), held, held_states, held_chances)


@njit(cache=True, nogil=True)
def _divided(boxes, covariances, labels, existence, report):  # type: ignore[no-untyped-def]
    """Boxes, labels, existence and covariances of the reported identities; labels, boxes and existence of held ones."""
    shown = np.flatnonzero(existence >= report)
    held = np.flatnonzero((existence < report) & (existence >= HELD))
    return (
        boxes[shown],
        labels[shown],
        np.maximum(existence[shown], REPORTED),
        covariances[shown],
        labels[held],
        boxes[held],
        np.minimum(existence[held], LARGEST_HELD),
    )
