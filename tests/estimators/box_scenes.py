"""Scenes of walking people as detections, for tests of box trackers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servotrack.estimators.boxes import BoxTracker
from servotrack.estimators.detect import Detections, detections_from_boxes
from servotrack.estimators.types import Array

WIDTH, HEIGHT = 20.0, 60.0


def person(x: float, y: float = 100.0) -> list[float]:
    """Box of a person with the given center."""
    return [x - WIDTH / 2, y - HEIGHT / 2, WIDTH, HEIGHT]


def people(xs: Sequence[float], appearances: Sequence[int] | None = None, size: int = 2) -> Detections:
    """Detections of people beside each other, with unit vectors as appearance."""
    found = detections_from_boxes([person(x) for x in xs])
    if appearances is None:
        return found
    return found._replace(features=np.eye(size)[list(appearances)].reshape(len(xs), size))


def blob(left: float, right: float, features: int = 2) -> Detections:
    """One blob, three quarters of whose box are foreground, of mixed appearance."""
    found = detections_from_boxes([[left, 70.0, right - left, HEIGHT]])
    mixed = np.full((1, features), 1.0 / np.sqrt(features)) if features else np.zeros((1, 0))
    return found._replace(areas=0.75 * found.areas, features=mixed)


def follow(tracker: BoxTracker, frames: Sequence[Detections]) -> list[dict[int, Array]]:
    """Reports of a tracker: identity to box, frame by frame."""
    state, answers = tracker.initial(frames[0]), []
    for detections in frames:
        state, estimate = tracker.step(state, detections)
        assert len(set(estimate.labels.tolist())) == len(estimate.labels)
        answers.append(dict(zip(estimate.labels.tolist(), estimate.states, strict=True)))
    return answers


def identity_at(answer: dict[int, Array], x: float, reach: float = 8.0) -> int:
    """Identity reported with the center at x; 0 for none."""
    near = {label: abs(box[0] + box[2] / 2 - x) for label, box in answer.items()}
    label = min(near, key=near.__getitem__, default=0)
    return label if label and near[label] <= reach else 0
