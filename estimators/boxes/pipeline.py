"""From frames to boxes with identities: a detector and a tracker as one estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from servotrack.estimators.rfs.sets import SetEstimate


class DetectThenTrackState(NamedTuple):
    """State of a `DetectThenTrack`.

    Attributes:
        detector: The detector's.
        tracker: The tracker's; None before the first frame.
    """

    detector: Any
    tracker: Any


@dataclass(frozen=True, eq=False)
class DetectThenTrack:
    """Frame in, boxes with identities out.

    Args:
        detector: As in `servotrack.estimators.detect`.
        tracker: As in `servotrack.estimators.boxes`.
    """

    detector: Any
    tracker: Any

    def initial(self, frames: ArrayLike) -> DetectThenTrackState:
        """State before the first frame; the detector may learn the background of what it is given.

        Args:
            frames: What the detector's `initial` takes: a frame, or several that are not answered.
        """
        return DetectThenTrackState(self.detector.initial(frames), None)

    def step(self, state: DetectThenTrackState, frame: ArrayLike) -> tuple[DetectThenTrackState, SetEstimate]:
        """Detect in a frame and track what was found.

        Args:
            state: As returned by `initial` or `step`.
            frame: RGB, uint8. Shape (H, W, 3).
        """
        detector, detections = self.detector.step(state.detector, frame)
        tracker = self.tracker.initial(detections) if state.tracker is None else state.tracker
        tracker, estimate = self.tracker.step(tracker, detections)
        return DetectThenTrackState(detector, tracker), estimate
