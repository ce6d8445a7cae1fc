"""Passive sonar with a line array: beamforming, and tracking of bearings before detection.

    tracker = HMMBearings()
    for track in tracker.track(record):  # beam powers, shape (rows, 721), one row per second
        print(track.label, track.first, track.last, track.bearings)

or online, with a delay of five rows and constant memory:

    online = Stateful(HMMBearings(lag=5))
    for row in record:
        estimate = online.step(row)
        print(estimate.labels, estimate.states[:, 0])  # deg

or from the channels of a recording and the places of its hydrophones:

    record = bearing_record(samples, rate, ElementArray(positions), band=(200.0, 400.0))
    tracks = record.tracker.track(record.powers)

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
from servotrack.estimators.sonar.beamforming import beam_powers, loaded_covariance
from servotrack.estimators.sonar.bearing_model import BearingModel
from servotrack.estimators.sonar.elements import ElementArray, aliasing_frequency
from servotrack.estimators.sonar.nulling import ViterbiNulling
from servotrack.estimators.sonar.peaks import PeakKalmanHungarian, PeakNearestNeighbor
from servotrack.estimators.sonar.record import BearingTrack
from servotrack.estimators.sonar.recording import BearingRecord, bearing_record
from servotrack.estimators.sonar.rules import (
    BackgroundRules,
    CrossingRules,
    FastRules,
    JoiningRules,
    LikelihoodRules,
    SearchRules,
    SpanRules,
)
from servotrack.estimators.sonar.tracker import BearingState, HMMBearings

__all__ = [
    "BackgroundRules",
    "Band",
    "BearingModel",
    "BearingRecord",
    "BearingState",
    "BearingTrack",
    "CrossingRules",
    "ElementArray",
    "FastRules",
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
    "aliasing_frequency",
    "beam_correlation",
    "beam_pattern",
    "beam_powers",
    "beamform",
    "bearing_record",
    "bearings",
    "loaded_covariance",
    "normalize",
    "shading_weights",
    "steering",
    "tabulate_pattern",
]
