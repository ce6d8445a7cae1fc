"""Metrics of trackers: distances between sets and between sets of trajectories, CLEAR MOT, IDF1 and HOTA."""

from servotrack.estimators.metrics.benchmarks import (
    BENCHMARKS,
    Benchmark,
    LabeledBoxes,
    benchmark_sequence,
    box_similarities,
    plain_boxes,
)
from servotrack.estimators.metrics.distances import (
    box_distances,
    centroid_distances,
    point_distances,
    wrapped_distances,
)
from servotrack.estimators.metrics.mot import MotScores, mot_scores, sequence_scores
from servotrack.estimators.metrics.sets import (
    GospaParts,
    SetScores,
    gospa,
    ospa,
    score_distances,
    score_points,
)
from servotrack.estimators.metrics.tracks import Track, members_by_step, stack_tracks, tracks_from_rows
from servotrack.estimators.metrics.trajectories import TrajectoryGospaParts, ospa2, trajectory_gospa

__all__ = [
    "BENCHMARKS",
    "Benchmark",
    "GospaParts",
    "LabeledBoxes",
    "MotScores",
    "SetScores",
    "Track",
    "TrajectoryGospaParts",
    "benchmark_sequence",
    "box_distances",
    "box_similarities",
    "centroid_distances",
    "gospa",
    "members_by_step",
    "mot_scores",
    "ospa",
    "ospa2",
    "plain_boxes",
    "point_distances",
    "score_distances",
    "score_points",
    "sequence_scores",
    "stack_tracks",
    "tracks_from_rows",
    "trajectory_gospa",
    "wrapped_distances",
]
