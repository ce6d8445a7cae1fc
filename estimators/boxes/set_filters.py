"""Boxes from any filter of `servotrack.estimators.rfs`: detections in as measurements, identities out as boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from servotrack.estimators.boxes.model import Kind, measurements
from servotrack.estimators.boxes.report import check_detections
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels

SIZE_RATE = 0.2
"""Weight of a new size in that of an identity whose filter knows only its centroid."""


class BoxSetState(NamedTuple):
    """State of a `BoxSetFilter`.

    Attributes:
        belief: The filter's.
        labels: Identities whose size is known. Shape (k,).
        shapes: Of each: the box's left and top less the centroid, width, height. Shape (k, 4), px.
    """

    belief: Any
    labels: Labels
    shapes: Array


@dataclass(frozen=True, eq=False)
class BoxSetFilter:
    """A set filter as a tracker of boxes.

    Args:
        filter: A filter of `servotrack.estimators.rfs` with a model of `servotrack.estimators.boxes.model`.
        kind: "centroid": the filter gets centroids, and the box around a reported one is that of the nearest
            detection, averaged over time. "box": the filter has sizes in its state.

    Raises:
        ValueError: A model whose measurement is of another size.
    """

    filter: Any
    kind: Kind = "centroid"

    def __post_init__(self) -> None:
        wanted, got = (2 if self.kind == "centroid" else 4), self.filter.model.packed.observation.shape[0]
        if wanted != got:
            raise ValueError(f"a filter of kind {self.kind!r} must measure {wanted} numbers, got a model with {got}")

    def initial(self, detections: Detections) -> BoxSetState:
        """State before the first frame; the detections are not looked at."""
        z = np.zeros((0, 2 if self.kind == "centroid" else 4))
        return BoxSetState(self.filter.initial(z), np.zeros(0, np.int64), np.zeros((0, 4)))

    def step(self, state: BoxSetState, detections: Detections) -> tuple[BoxSetState, SetEstimate]:
        """Predict to the next frame and fold its detections in.

        Raises:
            ValueError: Detections that are not finite.
        """
        check_detections(detections)
        belief, found = self.filter.step(state.belief, measurements(detections, self.kind))
        if self.kind == "box":
            shown = replace(
                found,
                states=_boxes(found.states),
                held_states=_boxes(found.held_states),
                covariances=_covariances(found),
            )
            return BoxSetState(belief, state.labels, state.shapes), shown
        labels = np.concatenate([found.labels, found.held_labels])
        centers = np.concatenate([found.states, found.held_states])[:, [0, 2]]
        shapes = _shapes(state, labels, centers, detections)
        boxes = shapes.copy()
        boxes[:, :2] += centers
        covariances = np.zeros((len(found.labels), 4, 4))
        covariances[:, :2, :2] = found.covariances[:, [[0], [2]], [0, 2]]
        count = len(found.labels)
        shown = replace(found, states=boxes[:count], held_states=boxes[count:], covariances=covariances)
        return BoxSetState(belief, labels, shapes), shown


def _boxes(states: Array) -> Array:
    """[x, vx, y, vy, w, h] as boxes."""
    size = np.maximum(states[:, 4:6], 1.0)
    return np.concatenate([states[:, [0, 2]] - size / 2.0, size], axis=1)


def _covariances(estimate: SetEstimate) -> Array:
    """Of boxes, from those of [x, vx, y, vy, w, h]."""
    J = np.array([[1, 0, 0, 0, -0.5, 0], [0, 0, 1, 0, 0, -0.5], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1.0]])
    return np.einsum("ij,kjl,ml->kim", J, estimate.covariances, J)


def _shapes(state: BoxSetState, labels: Labels, centers: Array, detections: Detections) -> Array:
    """The box around each identity's centroid: as remembered, mixed with that of the nearest detection that is near."""
    shapes = np.empty((len(labels), 4))
    remembered = _recall(state.labels, state.shapes, labels, shapes)
    if not remembered.all():
        shapes[~remembered] = _UNKNOWN if len(state.shapes) == 0 else np.median(state.shapes, axis=0)
    if len(detections.boxes):
        _learn(centers, remembered, detections.boxes, detections.centroids, shapes)
    return shapes


@njit(cache=True, nogil=True)
def _recall(known, known_shapes, labels, shapes):  # type: ignore[no-untyped-def]
    """Fill in the shapes of known labels; returns which are known."""
    found = np.zeros(len(labels), np.bool_)
    for k in range(len(labels)):
        for other in range(len(known)):
            if known[other] == labels[k]:
                shapes[k] = known_shapes[other]
                found[k] = True
                break
    return found


@njit(cache=True, nogil=True)
def _learn(centers, remembered, boxes, centroids, shapes):  # type: ignore[no-untyped-def]
    """Mix the shape of the nearest detection in; a shape that was not remembered is replaced by it."""
    for k in range(len(centers)):
        nearest, least = 0, np.inf
        for j in range(len(boxes)):
            dx, dy = centroids[j, 0] - centers[k, 0], centroids[j, 1] - centers[k, 1]
            distance = dx * dx + dy * dy
            if distance < least:
                nearest, least = j, distance
        # Farther than half a box away it is another one's.
        near = (
            abs(centroids[nearest, 0] - centers[k, 0]) <= 0.5 * shapes[k, 2]
            and abs(centroids[nearest, 1] - centers[k, 1]) <= 0.5 * shapes[k, 3]
        )
        if remembered[k] and not near:
            continue
        rate = SIZE_RATE if remembered[k] else 1.0
        for c in range(4):
            seen = boxes[nearest, c] - (centroids[nearest, c] if c < 2 else 0.0)
            shapes[k, c] += rate * (seen - shapes[k, c])


_UNKNOWN = np.array([-0.5, -0.5, 1.0, 1.0])
