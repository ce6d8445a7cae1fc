"""No filter: reports every detection, with new identities in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.boxes.report import checked_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate


@dataclass(frozen=True)
class RawDetections:
    """Reports every detection with a new identity; the state is the next new identity."""

    def initial(self, detections: Detections) -> int:
        """Return the first identity. Raises ValueError as `step` does."""
        checked_detections(detections)
        return 1

    def step(self, state: int, detections: Detections) -> tuple[int, SetEstimate]:
        """Report the detections of a frame.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`.
        """
        boxes = checked_detections(detections).boxes.copy()
        count = len(boxes)
        estimate = set_of_boxes(boxes, np.zeros((count, 4, 4)), state + np.arange(count), np.ones(count))
        return state + count, estimate
