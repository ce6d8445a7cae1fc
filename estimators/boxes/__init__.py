"""Trackers of boxes: detections in, people with identities out, frame by frame.

    tracker = Stateful(DetectThenTrack(MaskedBackground(), BoxPMB(frame_rate=25.0, frame_size=(384, 288))))
    for frame in frames:
        estimate = tracker.step(frame)
        print(estimate.labels, estimate.states)  # left, top, width, height

`BoxPMB` is the one to start with. Every tracker is a frozen dataclass with `initial(detections) -> state` and
`step(state, detections) -> (state, estimate)`; the filters of `servotrack.estimators.rfs` run behind `BoxSetFilter`,
and `KeptIdentities` keeps the identities of any of them. `fill_gaps` is for afterwards and makes tracks offline ones.
"""

from servotrack.estimators.boxes.hungarian import KalmanHungarian
from servotrack.estimators.boxes.identities import KeptIdentities
from servotrack.estimators.boxes.merged import split_merged
from servotrack.estimators.boxes.model import box_model, centroid_model
from servotrack.estimators.boxes.offline import fill_gaps
from servotrack.estimators.boxes.pipeline import DetectThenTrack
from servotrack.estimators.boxes.pmb import BoxPMB
from servotrack.estimators.boxes.raw import RawDetections
from servotrack.estimators.boxes.report import check_detections, set_of_boxes
from servotrack.estimators.boxes.set_filters import BoxSetFilter

__all__ = [
    "BoxPMB",
    "BoxSetFilter",
    "DetectThenTrack",
    "KalmanHungarian",
    "KeptIdentities",
    "RawDetections",
    "box_model",
    "centroid_model",
    "check_detections",
    "fill_gaps",
    "set_of_boxes",
    "split_merged",
]
