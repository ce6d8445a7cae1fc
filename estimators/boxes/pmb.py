"""Poisson multi-Bernoulli filter of boxes: existence of each person, occlusion, appearance and confidence.

The recursion is Williams (2015), with one Gaussian per track and states from the best assignment; existence comes from
the marginals of all assignments. What makes it a filter of people: all noises are shares of a person's height and
rates per second, so that one set of parameters serves other zooms and frame rates; a person behind a nearer one, or
missed in the last frame, is less likely to be detected and is waited for; a lost person keeps a small probability
of returning; blobs that cover several known people are taken apart; appearance weighs in where there is some.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from servotrack.estimators.boxes.kalman import center_boxes, correct_boxes, predict_boxes, started_boxes
from servotrack.estimators.boxes.merged import split_merged
from servotrack.estimators.boxes.overlap import covered_by
from servotrack.estimators.boxes.pmb_kernel import associate, mix_looks, pair_distances, visible_shares
from servotrack.estimators.boxes.report import box_covariances, check_detections, set_of_boxes
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels, Mask

GATE = float(chdtri(4, 1e-4))
"""Squared Mahalanobis distance beyond which no detection is a track's."""

UNCONFIRMED = 0.49
"""Highest existence told of a person who is not confirmed."""

FORGET = 0.01
"""Tracks less probable than this are dropped."""

ESTABLISHED = 3
"""Detections from which a lost person is remembered, and may be part of a merged blob."""

LEAST_VISIBLE = 0.02
"""Share of a person below which hiding no longer lowers the probability of detection."""

IN_FULL_VIEW = 0.7
"""Visible share from which a detection's appearance is the person's own."""

LOOK_RATE = 0.1
"""Least weight of a new frame in a track's mean appearance."""

LIKENESS = (-3.0, 1.5)
"""Range of the log likelihood ratio of an appearance."""

CONFIDENCES = 500
"""Number of last detections that the mean confidence mostly rests on."""


class BoxTracks(NamedTuple):
    """T tracks of people.

    Attributes:
        mean: Center column, its velocity, center row, its velocity, width, height. Shape (T, 6), px and px/s.
        variance: Of position, of position with velocity, of velocity, for columns and then rows; of width; of height.
            Shape (T, 8).
        existence: Shape (T,).
        label: Shape (T,).
        missed: Frames since the last detection. Shape (T,).
        seen: Detections so far. Shape (T,).
        look: Mean appearance, of unit length, or zero. Shape (T, F).
    """

    mean: Array
    variance: Array
    existence: Array
    label: Labels
    missed: Labels
    seen: Labels
    look: Array


class Confidence(NamedTuple):
    """Running mean of the detections' confidences, of their distance to it, and the number of detections."""

    mean: float
    deviation: float
    number: int


class BoxPMBState(NamedTuple):
    """State of a `BoxPMB`.

    Attributes:
        tracks: All that may exist.
        next_label: The next new identity.
        confidence: What confidences are usual.
    """

    tracks: BoxTracks
    next_label: int
    confidence: Confidence


@dataclass(frozen=True)
class BoxPMB:
    """Poisson multi-Bernoulli filter of boxes.

    Args:
        frame_rate: Frames per second.
        frame_size: Width and height, px; None where unknown: then nobody is known to leave.
        acceleration: Of people, heights/s^1.5.
        speed: Standard deviation of a new person's velocity, heights/s.
        drift: Relative change of sizes, 1/s^0.5.
        position_noise: Standard deviation of a detection's center, heights.
        size_noise: Of its width and height, heights.
        detection: Probability that a person in full view is detected, in (0, 1).
        patience: Time in which the probability that a missed person stays undetected falls to a half, s.
        surprise: Log of how much denser detections are at a person's exact prediction than false and new ones.
        birth: Probability that an unexplained detection is a person, in (0, 1).
        overlap: A detection of which a tracked person covers the share s is a new person (1 - s)^overlap as probably.
        doubt: A detection whose confidence lies this many mean deviations below the mean supports tracks and starts
            none (the second association of Zhang et al. 2022, on any scale of confidence).
        lifetime: Mean time for which people stay, s.
        velocity_memory: Time in which the velocity of an unseen person falls by e, s.
        memory: Time after which an unseen person is forgotten, s.
        revival: Probability up to then that a lost person is still there, in [0, 1).
        appearance: Log likelihood ratio per unit of similarity, at least 0.
        typical_similarity: Similarity that speaks neither for nor against one person.
        split: Whether blobs that cover several known people are taken apart.
        confirm: Detections before which nobody is reported, at least 1.

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    frame_rate: float = 25.0
    frame_size: tuple[int, int] | None = None
    acceleration: float = 0.2
    speed: float = 1.0
    drift: float = 0.07
    position_noise: float = 0.07
    size_noise: float = 0.18
    detection: float = 0.87
    patience: float = 0.055
    surprise: float = 10.0
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

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        for name in ("detection", "birth"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in (0, 1), got {getattr(self, name)!r}")
        if not 0.0 <= self.revival < 1.0:
            raise ValueError(f"revival must be in [0, 1), got {self.revival!r}")
        if self.confirm < 1:
            raise ValueError(f"confirm must be at least 1, got {self.confirm!r}")
        for name in ("overlap", "appearance"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)!r}")

    def initial(self, detections: Detections) -> BoxPMBState:
        """State before the first frame: nobody. The detections give the size of an appearance only."""
        none, features = np.zeros(0, np.int64), detections.features.shape[1]
        tracks = BoxTracks(np.zeros((0, 6)), np.zeros((0, 8)), np.zeros(0), none, none, none, np.zeros((0, features)))
        return BoxPMBState(tracks, 1, Confidence(0.0, 0.0, 0))

    def step(self, state: BoxPMBState, detections: Detections) -> tuple[BoxPMBState, SetEstimate]:
        """Predict to the next frame and fold its detections in.

        Raises:
            ValueError: Detections that are not finite, or appearances of another size.
        """
        check_detections(detections, state.tracks.look.shape[1])
        tracks, visible = self._predicted(state.tracks)
        if self.split:
            sure = (tracks.existence >= 0.5) & (tracks.seen >= ESTABLISHED)
            detections = split_merged(detections, center_boxes(tracks.mean[sure]))
        confidence = watched_confidence(state.confidence, detections.confidences)
        tracks, fresh = self._corrected(tracks, visible, detections)
        believable = detections.confidences >= confidence.mean - self.doubt * confidence.deviation
        after, next_label = self._extended(tracks, detections, self.birth * fresh * believable, state.next_label)
        covariances = box_covariances(after.variance[:, [0, 3]], after.variance[:, 6:])
        # Certain or not, who was detected less often than `confirm` times is held silently.
        shown = np.where(after.seen >= self.confirm, after.existence, np.minimum(after.existence, UNCONFIRMED))
        estimate = set_of_boxes(center_boxes(after.mean), covariances, after.label, shown)
        return BoxPMBState(after, next_label, confidence), estimate

    def _predicted(self, tracks: BoxTracks) -> tuple[BoxTracks, Array]:
        """Tracks in the next frame before its detections, and the share of each that nobody hides."""
        period = 1.0 / self.frame_rate
        motion = self.acceleration, self.drift, self.velocity_memory
        mean, variance = predict_boxes(tracks.mean, tracks.variance, tracks.missed, period, motion)
        width, height = self.frame_size or (0, 0)
        visible, inside = visible_shares(mean, tracks.existence, float(width), float(height))
        # Whoever is half outside the frame may be gone.
        staying = np.clip(2.0 * inside, 1e-3, 1.0)
        existence = tracks.existence * math.exp(-period / self.lifetime) * staying
        floor = np.where(tracks.seen >= ESTABLISHED, self.revival * staying, 0.0)
        return tracks._replace(mean=mean, variance=variance, existence=np.maximum(existence, floor)), visible

    def _corrected(self, tracks: BoxTracks, visible: Array, detections: Detections) -> tuple[BoxTracks, Array]:
        """Tracks after the detections, and the probability of each detection that no track explains it."""
        mean, variance, r = tracks.mean.copy(), tracks.variance.copy(), tracks.existence
        boxes = np.ascontiguousarray(detections.boxes, dtype=np.float64)
        noise = self.position_noise, self.size_noise
        again = 1.0 - 0.5 ** (1.0 / (self.frame_rate * self.patience))
        detectable = np.where(tracks.missed > 0, again, self.detection) * np.clip(visible, LEAST_VISIBLE, 1.0)
        absence = 1.0 - r * detectable
        distance, thinness = pair_distances(mean, variance, boxes, noise, GATE)
        log_weight = np.log(r * detectable / absence)[:, None] + self.surprise + thinness - 0.5 * distance
        if tracks.look.shape[1] and len(boxes):
            similar = tracks.look @ detections.features.T
            ratio = np.clip(self.appearance * (similar - self.typical_similarity), *LIKENESS)
            log_weight += np.where(similar > 0.0, ratio, 0.0)
        missed, assigned, fresh, partner = associate(np.exp(log_weight))
        correct_boxes(mean, variance, partner, boxes, noise)
        found = partner >= 0
        # What is some track's in the best assignment starts no other.
        fresh[partner[found]] = 0.0
        after = BoxTracks(
            mean,
            variance,
            np.minimum(missed * r * (1.0 - detectable) / absence + assigned, 1.0),
            tracks.label,
            np.where(found, 0, tracks.missed + 1),
            tracks.seen + found,
            _learned_looks(tracks, found & (visible >= IN_FULL_VIEW), partner, detections.features),
        )
        return after, fresh

    def _extended(self, tracks: BoxTracks, detections: Detections, chance: Array, label: int) -> tuple[BoxTracks, int]:
        """The tracks worth keeping, and a new one for each detection that no track explains."""
        sure = tracks.existence >= 0.5
        if sure.any() and len(chance):
            cover = covered_by(detections.boxes, center_boxes(tracks.mean[sure])).max(axis=1)
            chance = chance * np.maximum(1.0 - cover, 0.0) ** self.overlap
        keep = np.flatnonzero((tracks.existence >= FORGET) & (tracks.missed <= self.memory * self.frame_rate))
        new = np.flatnonzero(chance >= FORGET)
        if len(keep) == len(tracks.existence) and len(new) == 0:
            return tracks, label
        count = len(new)
        mean, variance = started_boxes(detections.boxes[new], self.position_noise, self.size_noise, self.speed)
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


def watched_confidence(known: Confidence, confidences: Array) -> Confidence:
    """Fold a frame's confidences into what is usual; a frame without detections changes nothing."""
    count = len(confidences)
    if count == 0:
        return known
    rate = min(count / min(known.number + count, CONFIDENCES), 1.0)
    mean = known.mean + rate * (float(np.mean(confidences)) - known.mean)
    deviation = known.deviation + rate * (float(np.mean(np.abs(confidences - mean))) - known.deviation)
    return Confidence(mean, deviation, known.number + count)


def _learned_looks(tracks: BoxTracks, own: Mask, partner: Labels, features: Array) -> Array:
    """Mean appearances after a frame, of those whose detection shows them and nobody else."""
    if features.shape[1] == 0 or not own.any():
        return tracks.look
    look = tracks.look.copy()
    mix_looks(look, own, partner, np.asarray(features, dtype=np.float64), tracks.seen, LOOK_RATE)
    return look


_POSITIVE = (
    "frame_rate",
    "acceleration",
    "speed",
    "drift",
    "position_noise",
    "size_noise",
    "patience",
    "lifetime",
    "velocity_memory",
    "memory",
)
