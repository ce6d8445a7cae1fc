"""No filter: reports every detection, with new identities in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.boxes.report import check_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate


@dataclass(frozen=True)
class RawDetections:
    """Reports every detection with a new identity; the state is the next new identity."""

    def initial(self, detections: Detections) -> int:
        """Return the first identity."""
        return 1

    def step(self, state: int, detections: Detections) -> tuple[int, SetEstimate]:
        """Report the detections of a frame.

        Raises:
            ValueError: Detections are not finite.
        """
        check_detections(detections)
        count = len(detections.boxes)
        boxes = np.array(detections.boxes, dtype=np.float64)
        estimate = set_of_boxes(boxes, np.zeros((count, 4, 4)), state + np.arange(count), np.ones(count))
        return state + count, estimate
