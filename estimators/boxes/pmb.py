"""Poisson multi-Bernoulli filter of boxes: existence of each person, occlusion, appearance and confidence.

The recursion is Williams (2015), with one Gaussian per track and states from the best assignment; existence comes from
the marginals of all assignments. It is specialized to people as follows. All noise is in shares of a person's height
and all rates are per second, so that one set of parameters serves other zooms and frame rates. A person behind a nearer
one, or missed in the last frame, has a lower detection probability, so the track survives longer. A lost person keeps
a small probability of returning. Blobs that cover several known people are split. Appearance enters the likelihood if
the detector gives it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from servotrack.estimators.boxes.kalman import center_boxes, correct_boxes, predict_boxes, started_boxes
from servotrack.estimators.boxes.merged import SplitRules, split_merged
from servotrack.estimators.boxes.overlap import covered_by
from servotrack.estimators.boxes.pmb_kernel import associate, mix_appearances, pair_distances, visible_shares
from servotrack.estimators.boxes.report import LARGEST_HELD, box_covariances, checked_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import REPORTED, SetEstimate
from servotrack.estimators.types import Array, Labels, Mask


class BoxTracks(NamedTuple):
    """T tracks of people.

    Attributes:
        mean: Center column, its velocity, center row, its velocity, width, height. Shape (T, 6), px and px/s.
        variance: Variance of the position, covariance of position and velocity, variance of the velocity, for columns
            and then for rows; then variances of width and height. Shape (T, 8).
        existence: Probabilities of existence. Shape (T,).
        label: Identities. Shape (T,).
        missed: Number of frames since the last detection. Shape (T,).
        seen: Number of detections so far. Shape (T,).
        appearance: Mean appearance vector of unit length, or zero. Shape (T, F).
    """

    mean: Array
    variance: Array
    existence: Array
    label: Labels
    missed: Labels
    seen: Labels
    appearance: Array


class Confidence(NamedTuple):
    """Running statistics of the detections' confidences.

    Attributes:
        mean: Mean confidence.
        deviation: Mean absolute deviation from it.
        number: Number of detections so far.
    """

    mean: float
    deviation: float
    number: int


class BoxPMBState(NamedTuple):
    """State of a `BoxPMB`.

    Attributes:
        tracks: Tracks of all people who may exist.
        next_label: The next new identity.
        confidence: Running statistics of the confidences.
    """

    tracks: BoxTracks
    next_label: int
    confidence: Confidence


@dataclass(frozen=True)
class BoxPMB:
    """Poisson multi-Bernoulli filter of boxes.

    Args:
        frame_rate: Frames per second.
        frame_size: Width and height of the frame, px; None if unknown: then the existence of people at the border does
            not fall.
        acceleration: Root spectral density of people's acceleration, heights/s^1.5. Raising it follows turns faster and
            smooths less.
        speed: Standard deviation of a new person's velocity, heights/s.
        drift: Relative random walk of sizes, 1/s^0.5.
        position_noise: Standard deviation of a detection's center, heights. Raising it smooths more.
        size_noise: Standard deviation of a detection's width and height, heights.
        detection: Probability that a person in full view is detected, in (0, 1). Raising it ends missed tracks sooner.
        miss_half_life: Half-life of the probability that a missed person stays undetected, s. Raising it keeps missed
            tracks longer.
        association_log_ratio: Log of the ratio of the density of detections at a person's exact prediction to that of
            false and new ones. Raising it assigns more distant detections to tracks.
        birth: Probability that an unexplained detection is a person, in (0, 1). Raising it reports people sooner, also
            false ones.
        overlap: The birth probability of a detection is multiplied by (1 - s)**overlap, with s the fraction covered by
            tracked people. Raising it starts fewer second tracks of one person.
        doubt: A detection whose confidence is more than this many mean deviations below the mean updates tracks but
            starts none (the second association of Zhang et al. 2022, on any scale of confidence).
        lifetime: Mean time for which people stay, s.
        velocity_memory: Time in which the velocity of an undetected person falls by a factor e, s.
        memory: Time after which an undetected person's track ends, s. Raising it bridges longer occlusions.
        revival: Probability until then that a lost person is still there, in [0, 1).
        appearance: Log likelihood ratio per unit of similarity, at least 0. Raising it gives appearance more weight.
        typical_similarity: Similarity at which the log likelihood ratio of an appearance is 0.
        split: True to split blobs that cover several known people.
        confirm: Number of detections from which a person is reported, at least 1.
        gate_tail: Probability that a person's own detection lies outside the gate, in (0, 1). Raising it makes the gate
            smaller.
        least_existence: Tracks of less existence are dropped, and detections of less birth probability start none.
        established: Number of detections from which `revival` applies and a person may be part of a merged blob.
        least_visible: Lower limit of the visible share of a person in the detection probability.
        full_view: Smallest visible share at which a detection's appearance updates the person's.
        appearance_rate: Smallest weight of a new frame in a track's mean appearance, in (0, 1].
        appearance_limits: Lower and upper limit of the log likelihood ratio of an appearance.
        confidence_memory: Approximate number of last detections in the mean confidence.
        smallest_size: Lower limit of a track's width and height, px.
        split_rules: Conditions under which a blob is split.

    Raises:
        ValueError: An argument is out of range.
    """

    frame_rate: float = 25.0
    frame_size: tuple[int, int] | None = None
    acceleration: float = 0.2
    speed: float = 1.0
    drift: float = 0.07
    position_noise: float = 0.07
    size_noise: float = 0.18
    detection: float = 0.87
    miss_half_life: float = 0.055
    association_log_ratio: float = 10.0
    birth: float = 0.03
    overlap: float = 8.0
    doubt: float = 1.6
    lifetime: float = 20.0
    velocity_memory: float = 5.0
    memory: float = 2.3
    revival: float = 0.04
    appearance: float = 6.0
    typical_similarity: float = 0.72
    split: bool = True
    confirm: int = 2
    gate_tail: float = 1e-4
    least_existence: float = 0.01
    established: int = 3
    least_visible: float = 0.02
    full_view: float = 0.7
    appearance_rate: float = 0.1
    appearance_limits: tuple[float, float] = (-3.0, 1.5)
    confidence_memory: int = 500
    smallest_size: float = 2.0
    split_rules: SplitRules = field(default_factory=SplitRules)

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        for name in ("detection", "birth", "gate_tail"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in (0, 1), got {getattr(self, name)!r}")
        if not 0.0 <= self.revival < 1.0:
            raise ValueError(f"revival must be in [0, 1), got {self.revival!r}")
        for name in ("confirm", "confidence_memory"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        for name in ("least_existence", "least_visible", "full_view", "appearance_rate"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in (0, 1], got {getattr(self, name)!r}")
        if not self.appearance_limits[0] <= self.appearance_limits[1]:
            raise ValueError(f"appearance_limits must be ascending, got {self.appearance_limits!r}")
        for name in ("overlap", "appearance"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)!r}")

    def initial(self, detections: Detections) -> BoxPMBState:
        """State before the first frame: no tracks. Only the length of the detections' appearance vectors is read.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`.
        """
        none, features = np.zeros(0, np.int64), checked_detections(detections).features.shape[1]
        tracks = BoxTracks(np.zeros((0, 6)), np.zeros((0, 8)), np.zeros(0), none, none, none, np.zeros((0, features)))
        return BoxPMBState(tracks, 1, Confidence(0.0, 0.0, 0))

    def step(self, state: BoxPMBState, detections: Detections) -> tuple[BoxPMBState, SetEstimate]:
        """Predict to the next frame and update with its detections.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`.
        """
        detections = checked_detections(detections, state.tracks.appearance.shape[1])
        tracks, visible = self._predicted(state.tracks)
        if self.split:
            known = (tracks.existence >= REPORTED) & (tracks.seen >= self.established)
            detections = split_merged(detections, center_boxes(tracks.mean[known]), self.split_rules)
        confidence = watched_confidence(state.confidence, detections.confidences, self.confidence_memory)
        tracks, fresh = self._corrected(tracks, visible, detections)
        believable = detections.confidences >= confidence.mean - self.doubt * confidence.deviation
        after, next_label = self._extended(tracks, detections, self.birth * fresh * believable, state.next_label)
        covariances = box_covariances(after.variance[:, [0, 3]], after.variance[:, 6:])
        # A track with fewer than `confirm` detections is held, whatever its existence.
        shown = np.where(after.seen >= self.confirm, after.existence, np.minimum(after.existence, LARGEST_HELD))
        estimate = set_of_boxes(center_boxes(after.mean), covariances, after.label, shown)
        return BoxPMBState(after, next_label, confidence), estimate

    @cached_property
    def _gate(self) -> float:
        """Largest squared Mahalanobis distance between a detection and a track's prediction."""
        return float(chdtri(4, self.gate_tail))

    def _predicted(self, tracks: BoxTracks) -> tuple[BoxTracks, Array]:
        """Tracks predicted to the next frame, and the visible share of each."""
        period = 1.0 / self.frame_rate
        motion = self.acceleration, self.drift, self.velocity_memory
        mean, variance = predict_boxes(tracks.mean, tracks.variance, tracks.missed, period, motion)
        width, height = self.frame_size or (0, 0)
        visible, inside = visible_shares(mean, tracks.existence, float(width), float(height))
        # A person who is more than half outside the frame may have left.
        staying = np.clip(2.0 * inside, 1e-3, 1.0)
        existence = tracks.existence * math.exp(-period / self.lifetime) * staying
        floor = np.where(tracks.seen >= self.established, self.revival * staying, 0.0)
        return tracks._replace(mean=mean, variance=variance, existence=np.maximum(existence, floor)), visible

    def _corrected(self, tracks: BoxTracks, visible: Array, detections: Detections) -> tuple[BoxTracks, Array]:
        """Tracks updated with the detections, and the probability of each detection that no track explains it."""
        mean, variance, r = tracks.mean.copy(), tracks.variance.copy(), tracks.existence
        boxes = np.ascontiguousarray(detections.boxes, dtype=np.float64)
        noise = self.position_noise, self.size_noise
        again = 1.0 - 0.5 ** (1.0 / (self.frame_rate * self.miss_half_life))
        detectable = np.where(tracks.missed > 0, again, self.detection) * np.clip(visible, self.least_visible, 1.0)
        absence = 1.0 - r * detectable
        distance, thinness = pair_distances(mean, variance, boxes, noise, self._gate)
        log_weight = np.log(r * detectable / absence)[:, None] + self.association_log_ratio + thinness - 0.5 * distance
        if tracks.appearance.shape[1] and len(boxes):
            similar = tracks.appearance @ detections.features.T
            ratio = np.clip(self.appearance * (similar - self.typical_similarity), *self.appearance_limits)
            log_weight += np.where(similar > 0.0, ratio, 0.0)
        missed, assigned, fresh, partner = associate(np.exp(log_weight))
        correct_boxes(mean, variance, partner, boxes, noise, float(self.smallest_size))
        found = partner >= 0
        # A detection that belongs to a track in the best assignment starts no other track.
        fresh[partner[found]] = 0.0
        after = BoxTracks(
            mean,
            variance,
            np.minimum(missed * r * (1.0 - detectable) / absence + assigned, 1.0),
            tracks.label,
            np.where(found, 0, tracks.missed + 1),
            tracks.seen + found,
            self._learned_appearances(tracks, found & (visible >= self.full_view), partner, detections.features),
        )
        return after, fresh

    def _extended(self, tracks: BoxTracks, detections: Detections, chance: Array, label: int) -> tuple[BoxTracks, int]:
        """Drop improbable tracks and add a new one for each detection that no track explains."""
        likely = tracks.existence >= REPORTED
        if likely.any() and len(chance):
            cover = covered_by(detections.boxes, center_boxes(tracks.mean[likely])).max(axis=1)
            chance = chance * np.maximum(1.0 - cover, 0.0) ** self.overlap
        lasting = tracks.missed <= self.memory * self.frame_rate
        keep = np.flatnonzero((tracks.existence >= self.least_existence) & lasting)
        new = np.flatnonzero(chance >= self.least_existence)
        if len(keep) == len(tracks.existence) and len(new) == 0:
            return tracks, label
        count = len(new)
        noise = self.position_noise, self.size_noise
        mean, variance = started_boxes(detections.boxes[new], noise, self.speed, self.smallest_size)
        arrivals = BoxTracks(
            mean,
            variance,
            chance[new],
            label + np.arange(count),
            np.zeros(count, np.int64),
            np.ones(count, np.int64),
            detections.features[new],
        )
        joined = [np.concatenate([old[keep], fresh]) for old, fresh in zip(tracks, arrivals, strict=True)]
        return BoxTracks(*joined), label + count

    def _learned_appearances(self, tracks: BoxTracks, own: Mask, partner: Labels, features: Array) -> Array:
        """Mean appearances after a frame; only tracks whose detection shows them alone are updated."""
        if features.shape[1] == 0 or not own.any():
            return tracks.appearance
        out = tracks.appearance.copy()
        vectors = np.asarray(features, dtype=np.float64)
        mix_appearances(out, own, partner, vectors, tracks.seen, float(self.appearance_rate))
        return out


def watched_confidence(known: Confidence, confidences: Array, memory: int) -> Confidence:
    """Update the statistics with the confidences of a frame; a frame without detections changes nothing.

    Args:
        known: Statistics so far.
        confidences: Confidences of the frame's detections. Shape (k,).
        memory: Approximate number of last detections in the mean.
    """
    count = len(confidences)
    if count == 0:
        return known
    rate = min(count / min(known.number + count, memory), 1.0)
    mean = known.mean + rate * (float(np.mean(confidences)) - known.mean)
    deviation = known.deviation + rate * (float(np.mean(np.abs(confidences - mean))) - known.deviation)
    return Confidence(mean, deviation, known.number + count)


_POSITIVE = (
    "frame_rate",
    "acceleration",
    "speed",
    "drift",
    "position_noise",
    "size_noise",
    "miss_half_life",
    "lifetime",
    "velocity_memory",
    "memory",
    "smallest_size",
)
