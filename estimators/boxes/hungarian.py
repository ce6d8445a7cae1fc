"""Kalman tracks and one Hungarian assignment by overlap per frame: the plain baseline (SORT, Bewley et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.kalman import center_boxes, correct_boxes, predict_boxes, started_boxes
from servotrack.estimators.boxes.report import box_covariances, check_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels

TENTATIVE = 0.25
"""Existence given for a track that is not confirmed."""


class KalmanState(NamedTuple):
    """State of a `KalmanHungarian`.

    Attributes:
        mean: As in `BoxTracks`. Shape (T, 6).
        variance: As in `BoxTracks`. Shape (T, 8).
        label: Shape (T,).
        hits: Frames in a row that detected the track, until it is confirmed. Shape (T,).
        missed: Frames since the last detection. Shape (T,).
        next_label: The next new identity.
    """

    mean: Array
    variance: Array
    label: Labels
    hits: Labels
    missed: Labels
    next_label: int


@dataclass(frozen=True)
class KalmanHungarian:
    """Kalman filters of boxes with nearly constant velocity, matched by overlap.

    Args:
        frame_rate: Frames per second.
        acceleration: Of people, heights/s^1.5.
        speed: Standard deviation of a new track's velocity, heights/s.
        drift: Relative change of sizes, 1/s^0.5.
        position_noise: Standard deviation of a detection's center, heights.
        size_noise: Of its width and height, heights.
        overlap: Least intersection over union of a match, in (0, 1).
        confirm: Detections in a row that confirm a track.
        misses: Frames without a detection after which a confirmed track ends.
        shown_misses: Frames without a detection for which it is still reported.

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    frame_rate: float = 25.0
    acceleration: float = 0.3
    speed: float = 0.7
    drift: float = 0.1
    position_noise: float = 0.08
    size_noise: float = 0.15
    overlap: float = 0.1
    confirm: int = 3
    misses: int = 8
    shown_misses: int = 2

    def __post_init__(self) -> None:
        for name in ("frame_rate", "acceleration", "speed", "drift", "position_noise", "size_noise"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)!r}")
        if not 0.0 < self.overlap < 1.0:
            raise ValueError(f"overlap must be in (0, 1), got {self.overlap!r}")
        if self.confirm < 1 or self.misses < 1 or self.shown_misses < 0:
            raise ValueError(
                "confirm and misses must be at least 1 and shown_misses at least 0, got "
                f"{self.confirm!r}, {self.misses!r}, {self.shown_misses!r}"
            )

    def initial(self, detections: Detections) -> KalmanState:
        """State before the first frame: no tracks; the detections are not looked at."""
        none = np.zeros(0, np.int64)
        return KalmanState(np.zeros((0, 6)), np.zeros((0, 8)), none, none, none, 1)

    def step(self, state: KalmanState, detections: Detections) -> tuple[KalmanState, SetEstimate]:
        """Predict, assign, correct.

        Raises:
            ValueError: Detections that are not finite.
        """
        check_detections(detections)
        boxes = np.array(detections.boxes, dtype=np.float64)
        noise = self.position_noise, self.size_noise
        motion = self.acceleration, self.drift, np.inf
        mean, variance = predict_boxes(state.mean, state.variance, state.missed, 1.0 / self.frame_rate, motion)
        tracks, count = len(mean), len(boxes)
        cost = np.ones((tracks, count + tracks)) - self.overlap
        cost[:, :count] = box_distances(center_boxes(mean), boxes)
        # A pair below the wanted overlap costs more than no partner.
        cost[:, :count][cost[:, :count] > 1.0 - self.overlap] = 2.0
        partner = assign(cost, tracks, count + tracks)
        partner[partner >= count] = -1
        correct_boxes(mean, variance, partner, boxes, noise)
        found = partner >= 0
        missed = np.where(found, 0, state.missed + 1)
        confirmed = state.hits >= self.confirm
        hits = np.where(confirmed, state.hits, np.where(found, state.hits + 1, 0))
        keep = np.flatnonzero((hits > 0) & (missed <= self.misses))
        new = np.setdiff1d(np.arange(count), partner)
        start, spread = started_boxes(boxes[new], self.position_noise, self.size_noise, self.speed)
        ones, zeros = np.ones(len(new), np.int64), np.zeros(len(new), np.int64)
        after = KalmanState(
            np.concatenate([mean[keep], start]),
            np.concatenate([variance[keep], spread]),
            np.concatenate([state.label[keep], state.next_label + np.arange(len(new))]),
            np.concatenate([hits[keep], ones]),
            np.concatenate([missed[keep], zeros]),
            state.next_label + len(new),
        )
        shown = (after.hits >= self.confirm) & (after.missed <= self.shown_misses)
        covariances = box_covariances(after.variance[:, [0, 3]], after.variance[:, 6:])
        existence = np.where(shown, 1.0, TENTATIVE)
        return after, set_of_boxes(center_boxes(after.mean), covariances, after.label, existence)
