"""Kalman tracks and one Hungarian assignment per frame: a simple baseline (SORT, Bewley et al. 2016).

SORT matches by overlap alone. Where detections have an appearance, a pair that looks alike costs less here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.boxes.identity_kernel import mix_appearances
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
        appearance: Mean appearance vector of unit length, or zero. Shape (T, F).
        next_label: The next new identity.
    """

    mean: Array
    variance: Array
    label: Labels
    hits: Labels
    missed: Labels
    appearance: Array
    next_label: int


@dataclass(frozen=True)
class KalmanHungarian:
    """Kalman filters of boxes with nearly constant velocity, matched by overlap and appearance.

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
        appearance: Overlap that a unit of similarity is worth in a match, at least 0; 0 for SORT. Raising it gives
            appearance more weight.
        typical_similarity: Similarity at which appearance counts neither for nor against a match.
        appearance_rate: Weight of a new frame in a track's mean appearance, in (0, 1].

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
    appearance: float = 0.25
    typical_similarity: float = 0.72
    appearance_rate: float = 0.1

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
        if not (np.isfinite(self.appearance) and self.appearance >= 0.0):
            raise ValueError(f"appearance must be finite and at least 0, got {self.appearance!r}")
        if not -1.0 <= self.typical_similarity <= 1.0:
            raise ValueError(f"typical_similarity must be in [-1, 1], got {self.typical_similarity!r}")
        if not 0.0 < self.appearance_rate <= 1.0:
            raise ValueError(f"appearance_rate must be in (0, 1], got {self.appearance_rate!r}")
        if self.confirm < 1 or self.misses < 1 or self.shown_misses < 0:
            raise ValueError(
                "confirm and misses must be at least 1 and shown_misses at least 0, got "
                f"{self.confirm!r}, {self.misses!r}, {self.shown_misses!r}"
            )

    def initial(self, detections: Detections) -> KalmanState:
        """State before the first frame: no tracks. Raises ValueError as `step` does."""
        features = checked_detections(detections).features
        none = np.zeros(0, np.int64)
        return KalmanState(np.zeros((0, 6)), np.zeros((0, 8)), none, none, none, features[:0], 1)

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
        detections = checked_detections(detections, state.appearance.shape[1])
        boxes, features = detections.boxes, detections.features
        noise = np.array([self.position_noise, self.position_noise, self.size_noise, self.size_noise])
        acceleration, drift = np.full(2, float(self.acceleration)), np.full(2, float(self.drift))
        period = checked_period(dt, self.frame_rate)
        mean, variance = predict_boxes(state.mean, state.variance, state.missed, period, acceleration, drift, np.inf)
        tracks, count = len(mean), len(boxes)
        cost = np.ones((tracks, count + tracks)) - self.overlap
        cost[:, :count] = box_distances(center_boxes(mean), boxes)
        # A pair with less overlap costs more than no partner.
        far = cost[:, :count] > 1.0 - self.overlap
        cost[:, :count] -= self._alike(state.appearance, features)
        cost[:, :count][far] = 2.0
        partner = assign(cost, tracks, count + tracks)
        partner[partner >= count] = -1
        correct_boxes(mean, variance, partner, boxes, noise, float(self.smallest_size))
        appearance = state.appearance
        if appearance.shape[1]:
            alone = np.zeros(tracks, np.int64)
            known = features.any(axis=1)
            appearance = mix_appearances(appearance, features, partner, known, alone, float(self.appearance_rate))
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
            np.concatenate([appearance[keep], features[new]]),
            state.next_label + len(new),
        )
        shown = (after.hits >= self.confirm) & (after.missed <= self.shown_misses)
        covariances = box_covariances(after.variance[:, [0, 3]], after.variance[:, 6:])
        existence = np.where(shown, 1.0, TENTATIVE_EXISTENCE)
        return after, set_of_boxes(center_boxes(after.mean), covariances, after.label, existence)

    def _alike(self, appearance: Array, features: Array) -> Array:
        """Overlap that the similarity of each pair is worth, 0 where either appearance is unknown. Shape (T, Z)."""
        if not (self.appearance and appearance.shape[1]):
            return np.zeros((len(appearance), len(features)))
        known = np.asarray(appearance.any(axis=1))[:, None] & features.any(axis=1)
        return np.where(known, self.appearance * (appearance @ features.T - self.typical_similarity), 0.0)
