"""Trackers of boxes: turn the detections of each frame into people with identities.

    tracker = Stateful(DetectThenTrack(MaskedBackground(), BoxPMB(frame_rate=25.0, frame_size=(384, 288))))
    for frame in frames:
        estimate = tracker.step(frame)
        print(estimate.labels, estimate.states)  # left, top, width, height

Start with `BoxPMB`. Every tracker is a frozen dataclass with `initial(detections) -> state` and
`step(state, detections) -> (state, estimate)`. `BoxSetFilter` makes a tracker of any filter of
`servotrack.estimators.rfs`, and `KeptIdentities` keeps the identities of any tracker through merges and short
occlusions. `people_count`, `ZoneCount` and `LineCount` turn estimates into numbers with intervals. `fill_gaps` is
offline post-processing.
"""

from servotrack.estimators.boxes.counting import Count, Crossings, LineCount, ZoneCount, people_count
from servotrack.estimators.boxes.hungarian import KalmanHungarian
from servotrack.estimators.boxes.identities import KeptIdentities
from servotrack.estimators.boxes.merged import SplitRules, split_merged
from servotrack.estimators.boxes.model import box_model, centroid_model
from servotrack.estimators.boxes.offline import fill_gaps
from servotrack.estimators.boxes.person import PersonOdds
from servotrack.estimators.boxes.pipeline import DetectThenTrack
from servotrack.estimators.boxes.pmb import BoxPMB
from servotrack.estimators.boxes.raw import RawDetections
from servotrack.estimators.boxes.report import BoxTracker, checked_detections, set_of_boxes
from servotrack.estimators.boxes.set_filters import BoxSetFilter

__all__ = [
    "BoxPMB",
    "BoxSetFilter",
    "BoxTracker",
    "Count",
    "Crossings",
    "DetectThenTrack",
    "KalmanHungarian",
    "KeptIdentities",
    "LineCount",
    "PersonOdds",
    "RawDetections",
    "SplitRules",
    "ZoneCount",
    "box_model",
    "centroid_model",
    "checked_detections",
    "fill_gaps",
    "people_count",
    "set_of_boxes",
    "split_merged",
]
