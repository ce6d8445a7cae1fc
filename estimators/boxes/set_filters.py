"""Trackers of boxes made from the filters of `servotrack.estimators.rfs`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.boxes.model import Kind, measurements
from servotrack.estimators.boxes.report import checked_detections
from servotrack.estimators.compilation import njit
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Estimator, Labels


class SetFilter(Estimator[ArrayLike, Any, SetEstimate], Protocol):
    """Filter over random finite sets with a model of one target."""

    @property
    def model(self) -> TargetModel:
        """Motion and measurement model of one target."""


class BoxSetState(NamedTuple):
    """State of a `BoxSetFilter`.

    Attributes:
        belief: State of the filter, of the filter's own type.
        labels: Identities whose size is known. Shape (k,).
        shapes: Left and top of each identity's box relative to its centroid, width, height. Shape (k, 4), px.
    """

    belief: Any
    labels: Labels
    shapes: Array


@dataclass(frozen=True, eq=False)
class BoxSetFilter:
    """A set filter as a tracker of boxes.

    Args:
        filter: A filter of `servotrack.estimators.rfs` with a model of `servotrack.estimators.boxes.model`.
        kind: "centroid": the filter tracks centroids, and the box around a centroid is that of the nearest detection,
            averaged over time. "box": the filter has sizes in its state.
        size_rate: Weight of a new box in the averaged box of an identity, in (0, 1], for "centroid" only. Raising it
            follows changes of size faster and averages less.

    Raises:
        ValueError: The model's measurement has another size, or `size_rate` is out of range.
    """

    filter: SetFilter
    kind: Kind = "centroid"
    size_rate: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 < self.size_rate <= 1.0:
            raise ValueError(f"size_rate must be in (0, 1], got {self.size_rate!r}")
        wanted, got = (2 if self.kind == "centroid" else 4), self.filter.model.packed.observation.shape[0]
        if wanted != got:
            raise ValueError(f"a filter of kind {self.kind!r} must measure {wanted} numbers, got a model with {got}")

    def initial(self, detections: Detections) -> BoxSetState:
        """State before the first frame: no targets. Raises ValueError as `step` does."""
        checked_detections(detections)
        z = np.zeros((0, 2 if self.kind == "centroid" else 4))
        return BoxSetState(self.filter.initial(z), np.zeros(0, np.int64), np.zeros((0, 4)))

    def step(self, state: BoxSetState, detections: Detections) -> tuple[BoxSetState, SetEstimate]:
        """Predict to the next frame and update with its detections.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`.
        """
        detections = checked_detections(detections)
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
        shapes = _shapes(state, labels, centers, detections, self.size_rate)
        boxes = shapes.copy()
        boxes[:, :2] += centers
        covariances = np.zeros((len(found.labels), 4, 4))
        covariances[:, :2, :2] = found.covariances[:, [[0], [2]], [0, 2]]
        count = len(found.labels)
        shown = replace(found, states=boxes[:count], held_states=boxes[count:], covariances=covariances)
        return BoxSetState(belief, labels, shapes), shown


def _boxes(states: Array) -> Array:
    """Convert states [x, vx, y, vy, w, h] to boxes."""
    size = np.maximum(states[:, 4:6], 1.0)
    return np.concatenate([states[:, [0, 2]] - size / 2.0, size], axis=1)


def _covariances(estimate: SetEstimate) -> Array:
    """Covariances of boxes from those of states [x, vx, y, vy, w, h]."""
    J = np.array([[1, 0, 0, 0, -0.5, 0], [0, 0, 1, 0, 0, -0.5], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1.0]])
    return np.einsum("ij,kjl,ml->kim", J, estimate.covariances, J)


def _shapes(state: BoxSetState, labels: Labels, centers: Array, detections: Detections, size_rate: float) -> Array:
    """Box around each identity's centroid: the known one, averaged with that of the nearest detection if it is near."""
    shapes = np.empty((len(labels), 4))
    remembered = _recall(state.labels, state.shapes, labels, shapes)
    if not remembered.all():
        # Without any known box, one of a single pixel.
        unknown = np.array([-0.5, -0.5, 1.0, 1.0])
        shapes[~remembered] = unknown if len(state.shapes) == 0 else np.median(state.shapes, axis=0)
    if len(detections.boxes):
        _learn(centers, remembered, detections.boxes, detections.centroids, float(size_rate), shapes)
    return shapes


@njit(cache=True, nogil=True)
def _recall(known, known_shapes, labels, shapes):  # type: ignore[no-untyped-def]
    """Fill in the shapes of known labels and return the mask of the known ones."""
    found = np.zeros(len(labels), np.bool_)
    for k in range(len(labels)):
        for other in range(len(known)):
            if known[other] == labels[k]:
                shapes[k] = known_shapes[other]
                found[k] = True
                break
    return found


@njit(cache=True, nogil=True)
def _learn(centers, remembered, boxes, centroids, size_rate, shapes):  # type: ignore[no-untyped-def]
    """Average the shape of the nearest detection in; it replaces a shape that was not remembered."""
    for k in range(len(centers)):
        nearest, least = 0, np.inf
        for j in range(len(boxes)):
            dx, dy = centroids[j, 0] - centers[k, 0], centroids[j, 1] - centers[k, 1]
            distance = dx * dx + dy * dy
            if distance < least:
                nearest, least = j, distance
        # A detection farther than half a box away belongs to another identity.
        near = (
            abs(centroids[nearest, 0] - centers[k, 0]) <= 0.5 * shapes[k, 2]
            and abs(centroids[nearest, 1] - centers[k, 1]) <= 0.5 * shapes[k, 3]
        )
        if remembered[k] and not near:
            continue
        rate = size_rate if remembered[k] else 1.0
        for c in range(4):
            seen = boxes[nearest, c] - (centroids[nearest, c] if c < 2 else 0.0)
            shapes[k, c] += rate * (seen - shapes[k, c])
