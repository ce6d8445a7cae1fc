"""No filter: what a detector finds is the answer, and nobody has an identity that lasts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.boxes.report import check_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate


@dataclass(frozen=True)
class RawDetections:
    """Reports every detection under an identity of its own; the state is the next new identity."""

    def initial(self, detections: Detections) -> int:
        """The first identity."""
        return 1

    def step(self, state: int, detections: Detections) -> tuple[int, SetEstimate]:
        """Report the detections of a frame.

        Raises:
            ValueError: Detections that are not finite.
        """
        check_detections(detections)
        count = len(detections.boxes)
        boxes = np.array(detections.boxes, dtype=np.float64)
        estimate = set_of_boxes(boxes, np.zeros((count, 4, 4)), state + np.arange(count), np.ones(count))
        return state + count, estimate
