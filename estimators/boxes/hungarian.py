"""Kalman tracks and one Hungarian assignment by overlap per frame: a simple baseline (SORT, Bewley et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.kalman import center_boxes, correct_boxes, predict_boxes, started_boxes
from servotrack.estimators.boxes.report import box_covariances, checked_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.rfs.sets import TENTATIVE_EXISTENCE, SetEstimate
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import checked_period


class KalmanState(NamedTuple):
    """State of a `KalmanHungarian`.

    Attributes:
        mean: Means as in `BoxTracks`. Shape (T, 6).
        variance: Variances as in `BoxTracks`. Shape (T, 8).
        label: Identities. Shape (T,).
        hits: Number of consecutive frames with a detection, until the track is confirmed. Shape (T,).
        missed: Number of frames since the last detection. Shape (T,).
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
        acceleration: Root spectral density of people's acceleration, heights/s^1.5. Raising it follows turns faster and
            smooths less.
        speed: Standard deviation of a new track's velocity, heights/s.
        drift: Relative random walk of sizes, 1/s^0.5.
        position_noise: Standard deviation of a detection's center, heights. Raising it smooths more.
        size_noise: Standard deviation of a detection's width and height, heights.
        overlap: Smallest intersection over union of a match, in (0, 1). Raising it breaks more tracks and confuses
            fewer people.
        confirm: Number of consecutive detections that confirm a track.
        misses: Number of frames without a detection after which a confirmed track ends.
        shown_misses: Number of frames without a detection for which a confirmed track is still reported.
        smallest_size: Lower limit of a track's width and height, px.

    Raises:
        ValueError: An argument is out of range.
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
    smallest_size: float = 2.0

    def __post_init__(self) -> None:
        for name in (
            "frame_rate",
            "acceleration",
            "speed",
            "drift",
            "position_noise",
            "size_noise",
            "smallest_size",
        ):
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
        """State before the first frame: no tracks. Raises ValueError as `step` does."""
        checked_detections(detections)
        none = np.zeros(0, np.int64)
        return KalmanState(np.zeros((0, 6)), np.zeros((0, 8)), none, none, none, 1)

    def step(
        self, state: KalmanState, detections: Detections, dt: float | None = None
    ) -> tuple[KalmanState, SetEstimate]:
        """Predict, assign, correct.

        Args:
            state: State after the last frame.
            detections: Detections of this frame.
            dt: Time since the last frame, s; None for 1 / `frame_rate`.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`, or `dt` is not positive.
        """
        boxes = checked_detections(detections).boxes
        noise = np.array([self.position_noise, self.position_noise, self.size_noise, self.size_noise])
        acceleration, drift = np.full(2, float(self.acceleration)), np.full(2, float(self.drift))
        period = checked_period(dt, self.frame_rate)
        mean, variance = predict_boxes(state.mean, state.variance, state.missed, period, acceleration, drift, np.inf)
        tracks, count = len(mean), len(boxes)
        cost = np.ones((tracks, count + tracks)) - self.overlap
        cost[:, :count] = box_distances(center_boxes(mean), boxes)
        # A pair with less overlap costs more than no partner.
        cost[:, :count][cost[:, :count] > 1.0 - self.overlap] = 2.0
        partner = assign(cost, tracks, count + tracks)
        partner[partner >= count] = -1
        correct_boxes(mean, variance, partner, boxes, noise, float(self.smallest_size))
        found = partner >= 0
        missed = np.where(found, 0, state.missed + 1)
        confirmed = state.hits >= self.confirm
        hits = np.where(confirmed, state.hits, np.where(found, state.hits + 1, 0))
        keep = np.flatnonzero((hits > 0) & (missed <= self.misses))
        new = np.setdiff1d(np.arange(count), partner)
        start, spread = started_boxes(boxes[new], noise, self.speed, self.smallest_size)
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
        existence = np.where(shown, 1.0, TENTATIVE_EXISTENCE)
        return after, set_of_boxes(center_boxes(after.mean), covariances, after.label, existence)
