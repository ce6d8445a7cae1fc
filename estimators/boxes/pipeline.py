"""A detector and a tracker of boxes as one estimator: from frames to boxes with identities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from servotrack.estimators.boxes.report import BoxTracker
from servotrack.estimators.detect.detections import Detector
from servotrack.estimators.rfs.sets import SetEstimate


class DetectThenTrackState(NamedTuple):
    """State of a `DetectThenTrack`.

    Attributes:
        detector: State of the detector, of the detector's own type.
        tracker: State of the tracker, of the tracker's own type; None before the first frame.
    """

    detector: Any
    tracker: Any


@dataclass(frozen=True, eq=False)
class DetectThenTrack:
    """Detects in every frame and tracks the detections.

    Args:
        detector: A detector of `servotrack.estimators.detect`.
        tracker: A tracker of `servotrack.estimators.boxes`.
    """

    detector: Detector
    tracker: BoxTracker

    def initial(self, frames: ArrayLike) -> DetectThenTrackState:
        """State before the first frame; the detector may learn the background from the given frames.

        Args:
            frames: Input of the detector's `initial`: one frame, or several frames, for which no boxes are reported.
        """
        return DetectThenTrackState(self.detector.initial(frames), None)

    def step(
        self, state: DetectThenTrackState, frame: ArrayLike, dt: float | None = None
    ) -> tuple[DetectThenTrackState, SetEstimate]:
        """Detect in a frame and track the detections.

        Args:
            state: Result of `initial` or of the last `step`.
            frame: RGB, uint8. Shape (H, W, 3).
            dt: Time since the last frame, s, for a detector and a tracker whose `step` takes it; None for the nominal
                one of each.
        """
        known: dict[str, Any] = {} if dt is None else {"dt": dt}
        detector, detections = self.detector.step(state.detector, frame, **known)
        tracker = self.tracker.initial(detections) if state.tracker is None else state.tracker
        tracker, estimate = self.tracker.step(tracker, detections, **known)
        return DetectThenTrackState(detector, tracker), estimate
