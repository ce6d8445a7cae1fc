"""Passive sonar with a line array: beamforming, and tracking of bearings before detection.

    tracker = HMMBearings()
    for track in tracker.track(record):  # beam powers, shape (rows, 721), one row per second
        print(track.label, track.first, track.last, track.bearings)

or online, with a delay of five rows and constant memory:

    online = Stateful(HMMBearings(lag=5))
    for row in record:
        estimate = online.step(row)
        print(estimate.labels, estimate.states[:, 0])  # deg

`PeakNearestNeighbor`, `PeakKalmanHungarian` and `ViterbiNulling` are baselines with the same methods.
"""

from servotrack.estimators.sonar.array import (
    Band,
    LineArray,
    PatternTable,
    beam_correlation,
    beam_pattern,
    beamform,
    bearings,
    normalize,
    shading_weights,
    steering,
    tabulate_pattern,
)
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.nulling import ViterbiNulling
from servotrack.estimators.sonar.peaks import PeakKalmanHungarian, PeakNearestNeighbor
from servotrack.estimators.sonar.record import BearingTrack
from servotrack.estimators.sonar.rules import CrossingRules, JoiningRules, LikelihoodRules, SearchRules, SpanRules
from servotrack.estimators.sonar.tracker import BearingState, HMMBearings

__all__ = [
    "Band",
    "BearingModel",
    "BearingState",
    "BearingTrack",
    "CrossingRules",
    "HMMBearings",
    "JoiningRules",
    "LikelihoodRules",
    "LineArray",
    "PatternTable",
    "PeakKalmanHungarian",
    "PeakNearestNeighbor",
    "SearchRules",
    "SpanRules",
    "ViterbiNulling",
    "beam_correlation",
    "beam_pattern",
    "beamform",
    "bearings",
    "normalize",
    "shading_weights",
    "steering",
    "tabulate_pattern",
]
