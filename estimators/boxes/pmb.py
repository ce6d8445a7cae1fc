"""Poisson multi-Bernoulli filter of boxes: existence of each person, occlusion, appearance and confidence.

The recursion is Williams (2015), with one Gaussian per track and states from the best assignment; existence comes from
the marginals of all assignments. It is specialized to people as follows. All noise is in shares of a person's height
and all rates are per second, so that one set of parameters serves other zooms and frame rates, and the noise of a
sequence is learned from its innovations (`noise`). A person behind a nearer one, or missed in the last frame, has a
lower detection probability, so the track survives longer. A lost person keeps a small probability of returning. Blobs
that cover several known people are split. Appearance enters the likelihood if the detector gives it.

A track is something that persists; it need not be a person. The probability that it is one follows from the scores of
its detections, whose scale is learned (`confidence`), and from its height at its place in the image (`perspective`).
Existence is the product of both probabilities. Only people with a detection in the frame are reported; all others are
held.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from servotrack.estimators.boxes.camera import (
    CameraRules,
    CameraState,
    camera_step,
    checked_motion,
    initial_camera,
    move_tracks,
    seen_camera,
)
from servotrack.estimators.boxes.confidence import (
    ScoreRules,
    initial_confidence,
    learn_persistence,
    read_scores,
    score_log_odds,
    trust,
)
from servotrack.estimators.boxes.kalman import center_boxes, correct_boxes, predict_boxes, started_boxes
from servotrack.estimators.boxes.meetings import MeetingRules, meet
from servotrack.estimators.boxes.merged import SplitRules, split_merged
from servotrack.estimators.boxes.noise import NoiseLearning, NoiseScales, initial_noise, learn_noise
from servotrack.estimators.boxes.person import PersonOdds
from servotrack.estimators.boxes.perspective import HeightRules, height_errors, initial_heights
from servotrack.estimators.boxes.pmb_kernel import (
    associate,
    birth_chances,
    detection_odds,
    judge_tracks,
    mix_appearances,
    pair_log_weights,
    region_share,
    remaining_existence,
    settled,
    stated_existence,
    visible_shares,
)
from servotrack.estimators.boxes.pmb_tracks import BoxTracks, new_tracks
from servotrack.estimators.boxes.report import (
    LARGEST_HELD,
    box_covariances,
    checked_detections,
    set_of_boxes,
)
from servotrack.estimators.boxes.shared import SharingRules, correct_within, shared_regions
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.sets import REPORTED, SetEstimate
from servotrack.estimators.types import Array, Labels, Mask
from servotrack.estimators.validation import checked_period


class BoxPMBState(NamedTuple):
    """State of a `BoxPMB`.

    Attributes:
        tracks: Tracks of all people who may exist.
        next_label: The next new identity.
        noise: Noise of this sequence.
        confidence: Scale of the scores, see `initial_confidence`. Shape (10,).
        heights: Heights by place in the image, see `initial_heights`. Shape (11,).
        camera: Motion of the camera.
    """

    tracks: BoxTracks
    next_label: int
    noise: NoiseScales
    confidence: Array
    heights: Array
    camera: CameraState


class _Frame(NamedTuple):
    """Detections of a frame and what is known about them.

    Attributes:
        detections: Detections, merged blobs split.
        reading: Scores as read. Shape (Z,).
        odds: Log odds of the scores. Shape (Z,).
        dt: Time since the last frame, s.
        noise: Standard deviations of the measurements, heights. Shape (4,).
        cut: Share of regions that show a part of a person, or more than one.
    """

    detections: Detections
    reading: Array
    odds: Array
    dt: float
    noise: Array
    cut: float


@dataclass(frozen=True)
class BoxPMB:
    """Poisson multi-Bernoulli filter of boxes.

    Args:
        frame_rate: Frames per second, where `step` is not given the time between frames.
        frame_size: Width and height of the frame, px; None if unknown: then the existence of people at the border does
            not fall.
        acceleration: Initial root spectral density of people's acceleration, heights/s^1.5. Raising it follows turns
            faster and smooths less.
        speed: Standard deviation of a new person's velocity, heights/s.
        drift: Initial relative random walk of sizes, 1/s^0.5.
        position_noise: Initial standard deviation of a detection's center, heights. Raising it smooths more.
        size_noise: Initial standard deviation of a detection's width and height, heights.
        learning: Gains by which the noise of the sequence is learned; None keeps the initial noise.
        detection: Probability that a person in full view is detected, in (0, 1). Raising it ends missed tracks sooner.
        miss_half_life: Half-life of the probability that a missed person stays undetected, s. Raising it keeps missed
            tracks longer.
        clutter_log_density: Log density of false and new detections, heights^-4. Raising it assigns fewer distant
            detections to tracks.
        score_weight: Weight of a detection's log odds in its assignment to tracks. Raising it assigns fewer detections
            of low scores.
        typical_score: Log odds at which the score does not matter in the assignment.
        birth: Probability that an unexplained detection belongs to something that persists, in (0, 1). Raising it
            reports people sooner, also false ones.
        overlap: The birth probability of a detection is multiplied by (1 - s)**overlap, with s the fraction covered by
            tracked people. Raising it starts fewer second tracks of one person.
        person: Log odds that a track is a person.
        scores: Reading of scores.
        heights: Learning of heights.
        report: Smallest existence of reported people, in (0, 1). Raising it reports fewer.
        coast: Time for which undetected people are still reported, s; 0 for those with a detection in the frame only.
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
        full_view: Smallest visible share at which a detection's appearance updates the person's, and at which a missed
            detection says something about the scores.
        appearance_rate: Smallest weight of a new frame in a track's mean appearance, in (0, 1].
        appearance_limits: Lower and upper limit of the log likelihood ratio of an appearance.
        smallest_size: Lower limit of a track's width and height, px.
        cut_share: Share of regions that show a part of a person or more than one, in [0, 1), where scores say nothing.
            Raising it follows people whose regions are cut or joined, and takes more of the neighbors' detections.
        cut_scale: Factor of the standard deviations of such regions, at least 1.
        camera: Estimation of the camera's motion from the tracks; None: the camera stands still.
        turning: Speed of the camera, in units of `speed`, from which people outside the frame are expected back.
            Raising it lets them go as if they had walked out.
        sharing: Conditions under which people share a region, where scores say nothing.
        meetings: Conditions under which people who met and parted exchange their identities.
        split_rules: Conditions under which a blob is split.

    Raises:
        ValueError: An argument is out of range.
    """

    frame_rate: float = 25.0
    frame_size: tuple[int, int] | None = None
    acceleration: float = 0.25
    speed: float = 0.9
    drift: float = 0.11
    position_noise: float = 0.065
    size_noise: float = 0.13
    learning: NoiseLearning | None = field(default_factory=NoiseLearning)
    detection: float = 0.8
    miss_half_life: float = 0.12
    clutter_log_density: float = -0.5
    score_weight: float = 0.5
    typical_score: float = 2.5
    birth: float = 0.9
    overlap: float = 10.0
    person: PersonOdds = field(default_factory=PersonOdds)
    scores: ScoreRules = field(default_factory=ScoreRules)
    heights: HeightRules = field(default_factory=HeightRules)
    report: float = 0.42
    coast: float = 0.0
    lifetime: float = 20.0
    velocity_memory: float = 2.0
    memory: float = 2.0
    revival: float = 0.03
    appearance: float = 6.0
    typical_similarity: float = 0.72
    split: bool = True
    confirm: int = 1
    gate_tail: float = 1e-5
    least_existence: float = 0.01
    established: int = 3
    least_visible: float = 0.02
    full_view: float = 0.7
    appearance_rate: float = 0.1
    appearance_limits: tuple[float, float] = (-3.0, 1.5)
    smallest_size: float = 2.0
    cut_share: float = 0.05
    cut_scale: float = 3.0
    camera: CameraRules | None = field(default_factory=CameraRules)
    turning: float = 0.1
    sharing: SharingRules = field(default_factory=SharingRules)
    meetings: MeetingRules = field(default_factory=MeetingRules)
    split_rules: SplitRules = field(default_factory=SplitRules)

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        for name in ("detection", "birth", "gate_tail", "report"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be in (0, 1), got {getattr(self, name)!r}")
        if not 0.0 <= self.revival < 1.0:
            raise ValueError(f"revival must be in [0, 1), got {self.revival!r}")
        if not 0.0 <= self.cut_share < 1.0:
            raise ValueError(f"cut_share must be in [0, 1), got {self.cut_share!r}")
        if not 1.0 <= self.cut_scale < math.inf:
            raise ValueError(f"cut_scale must be finite and at least 1, got {self.cut_scale!r}")
        if self.confirm < 1:
            raise ValueError(f"confirm must be at least 1, got {self.confirm!r}")
        for name in ("least_existence", "least_visible", "full_view", "appearance_rate"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in (0, 1], got {getattr(self, name)!r}")
        if not self.appearance_limits[0] <= self.appearance_limits[1]:
            raise ValueError(f"appearance_limits must be ascending, got {self.appearance_limits!r}")
        for name in ("overlap", "appearance", "score_weight", "coast", "turning"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)!r}")

    def initial(self, detections: Detections) -> BoxPMBState:
        """State before the first frame: no tracks. Only the length of the detections' appearance vectors is read.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`.
        """
        features = checked_detections(detections).features
        tracks = new_tracks(np.zeros((0, 6)), np.zeros((0, 8)), np.zeros(0), 1, np.zeros(0), features[:0])
        return BoxPMBState(
            tracks, 1, initial_noise(), initial_confidence(self.scores), initial_heights(), initial_camera()
        )

    def step(
        self, state: BoxPMBState, detections: Detections, dt: float | None = None, motion: ArrayLike | None = None
    ) -> tuple[BoxPMBState, SetEstimate]:
        """Predict to the next frame and update with its detections.

        Args:
            state: State after the last frame.
            detections: Detections of this frame.
            dt: Time since the last frame, s; None for 1 / `frame_rate`.
            motion: Motion of the picture by the camera: maps a point (x, y, 1) of the last frame to this one, as
                `servotrack.estimators.detect.PictureMotion` finds it. None: it is estimated from the tracks. Shape
                (2, 3), px.

        Raises:
            ValueError: Detections are invalid, see `checked_detections`, `dt` is not positive, or `motion` has another
                shape or is not finite.
        """
        detections = checked_detections(detections, state.tracks.appearance.shape[1])
        dt = checked_period(dt, self.frame_rate)
        noise = self._measurement_noise * np.exp(0.5 * state.noise.measurement)
        tracks, visible = self._predicted(state.tracks, state.noise, state.camera, dt)
        tracks, camera = self._steadied(state.camera, tracks, detections, noise, dt, motion)
        regions = region_share(detections.boxes, detections.areas, self.split_rules.solid)
        if self.split and regions > 0.0:
            known = (tracks.existence >= REPORTED) & (tracks.seen >= self.established)
            deviation = height_errors(state.heights, np.ascontiguousarray(detections.boxes), self.heights)
            detections = split_merged(detections, center_boxes(tracks.mean[known]), self.split_rules, deviation)
        confidence, reading = read_scores(
            state.confidence, np.ascontiguousarray(detections.confidences), regions, self.scores
        )
        odds = score_log_odds(confidence, reading, self.scores)
        frame = _Frame(detections, reading, odds, dt, noise, self.cut_share * (1.0 - trust(confidence)))
        tracks, fresh = self._corrected(tracks, visible, frame)
        found = tracks.missed == 0
        counts = (state.tracks.missed == 0) & (visible >= self.full_view)
        learn_persistence(confidence, state.tracks.reading, found, counts, dt, self.scores)
        scales = self._learned_noise(state, tracks, found)
        tracks, next_label = self._extended(tracks, frame, fresh, state.next_label)
        tracks, heights = self._judged(tracks, frame, confidence, state.heights)
        return BoxPMBState(tracks, next_label, scales, confidence, heights, camera), self._estimate(tracks)

    @cached_property
    def _gate(self) -> float:
        """Largest squared Mahalanobis distance between a detection and a track's prediction."""
        return float(chdtri(4, self.gate_tail))

    @cached_property
    def _measurement_noise(self) -> Array:
        """Initial standard deviations of the measurements, heights. Shape (4,)."""
        return np.array([self.position_noise, self.position_noise, self.size_noise, self.size_noise])

    @cached_property
    def _process_noise(self) -> Array:
        """Initial process noise: acceleration twice, drift twice. Shape (4,)."""
        return np.array([self.acceleration, self.acceleration, self.drift, self.drift])

    def _predicted(
        self, tracks: BoxTracks, scales: NoiseScales, camera: CameraState, dt: float
    ) -> tuple[BoxTracks, Array]:
        """Tracks predicted to the next frame, and the visible share of each."""
        process = self._process_noise * np.exp(0.5 * scales.process)
        mean, variance = predict_boxes(
            tracks.mean, tracks.variance, tracks.missed, dt, process[:2], process[2:], float(self.velocity_memory)
        )
        width, height = self.frame_size or (0, 0)
        there = tracks.existence * tracks.person
        visible, inside = visible_shares(mean, there, float(width), float(height))
        # A person who is more than half outside the frame may have left, if it was not the camera that turned away.
        existence = remaining_existence(
            (mean, tracks.existence, tracks.seen),
            inside,
            camera.velocity,
            math.exp(-dt / self.lifetime),
            self.turning * self.speed,
            self.established,
            float(self.revival),
        )
        return tracks._replace(mean=mean, variance=variance, existence=existence), visible

    def _steadied(
        self,
        state: CameraState,
        tracks: BoxTracks,
        detections: Detections,
        noise: Array,
        dt: float,
        motion: ArrayLike | None,
    ) -> tuple[BoxTracks, CameraState]:
        """Tracks moved by the motion of the camera."""
        if motion is not None:
            known = checked_motion(motion)
            mean, variance = move_tracks(tracks.mean, tracks.variance, known)
            return tracks._replace(mean=mean, variance=variance), seen_camera(known, self.frame_size, dt)
        if self.camera is None:
            return tracks, state
        told = (tracks.missed == 0) & (tracks.seen >= self.established)
        weight = np.where(told, tracks.existence, 0.0)
        state = camera_step(state, tracks.mean, tracks.variance, weight, detections.boxes, noise, dt, self.camera)
        mean = tracks.mean.copy()
        mean[:, [0, 2]] += state.shift
        return tracks._replace(mean=mean), state

    def _corrected(self, tracks: BoxTracks, visible: Array, frame: _Frame) -> tuple[BoxTracks, Array]:
        """Tracks updated with the detections, and the probability of each detection that no track explains it."""
        mean, variance, boxes = tracks.mean.copy(), tracks.variance.copy(), frame.detections.boxes
        detectable, odds = detection_odds(
            (tracks.existence, tracks.missed),
            visible,
            self.detection,
            1.0 - 0.5 ** (frame.dt / self.miss_half_life),
            self.least_visible,
            self.clutter_log_density,
        )
        log_weight = pair_log_weights(
            mean,
            variance,
            boxes,
            frame.noise,
            self._gate,
            odds,
            self.score_weight * (frame.odds - self.typical_score),
            frame.cut,
            float(self.cut_scale),
        )
        if tracks.appearance.shape[1] and len(boxes):
            similar = tracks.appearance @ frame.detections.features.T
            ratio = np.clip(self.appearance * (similar - self.typical_similarity), *self.appearance_limits)
            log_weight += np.where(similar > 0.0, ratio, 0.0)
        missed, assigned, fresh, partner = associate(np.exp(log_weight))
        shared = self._shared(tracks, frame, boxes, partner)
        together = shared >= 0
        fresh[shared[together]] = 0.0
        partner[together] = -1
        correct_within(mean, variance, shared, boxes, frame.noise, self.sharing)
        innovation = correct_boxes(mean, variance, partner, boxes, frame.noise, float(self.smallest_size))
        found = partner >= 0
        # A detection that belongs to a track in the best assignment starts no other track.
        fresh[partner[found]] = 0.0
        existence, frames, absent, seen, reading, readings = settled(
            (tracks.existence, tracks.missed, tracks.absent, tracks.seen, tracks.reading, tracks.readings),
            partner,
            together,
            detectable,
            (missed, assigned),
            frame.reading,
            frame.dt,
        )
        after = tracks._replace(
            mean=mean,
            variance=variance,
            existence=existence,
            missed=frames,
            absent=absent,
            seen=seen,
            shares=together,
            reading=reading,
            readings=readings,
            innovation=innovation,
            appearance=self._learned_appearances(
                tracks, found & (visible >= self.full_view), partner, frame.detections.features
            ),
        )
        return self._parted(after, partner, frame), fresh

    def _parted(self, tracks: BoxTracks, partner: Labels, frame: _Frame) -> BoxTracks:
        """Tracks with the identities that people who met and parted have by their appearance."""
        features = frame.detections.features
        if features.shape[1] == 0 or len(partner) < 2:
            return tracks
        known = (tracks.existence >= REPORTED) & (tracks.seen >= self.established)
        changed = {name: getattr(tracks, name).copy() for name in ("label", "rival", "parted", "appearance", "before")}
        meet(
            tuple(changed.values()), known, center_boxes(tracks.mean), partner,
            np.ascontiguousarray(frame.detections.boxes), np.asarray(features, np.float64), frame.dt, self.meetings,
        )  # fmt: skip
        return tracks._replace(**changed)

    def _shared(self, tracks: BoxTracks, frame: _Frame, boxes: Array, partner: Labels) -> Labels:
        """Region that each track shares with others, -1 for none; only where scores say nothing."""
        none = np.full(len(partner), -1)
        if frame.cut < 0.5 * self.cut_share:
            return none
        known = (tracks.existence >= REPORTED) & (tracks.seen >= self.established)
        known &= tracks.absent < self.sharing.longest
        region = frame.detections.areas < self.split_rules.solid * boxes[:, 2] * boxes[:, 3]
        if known.sum() < 2 or not region.any():
            return none
        predicted = center_boxes(tracks.mean)
        return np.asarray(shared_regions(predicted, known, boxes, region, partner, self.sharing))

    def _extended(self, tracks: BoxTracks, frame: _Frame, fresh: Array, label: int) -> tuple[BoxTracks, int]:
        """Drop improbable tracks and add a new one for each detection that no track explains."""
        chance = birth_chances(
            frame.detections.boxes, (tracks.mean, tracks.existence), fresh, self.birth, float(self.overlap)
        )
        keep = np.flatnonzero((tracks.existence >= self.least_existence) & (tracks.absent <= self.memory))
        new = np.flatnonzero(chance >= self.least_existence)
        if len(keep) == len(tracks.existence) and len(new) == 0:
            return tracks, label
        mean, variance = started_boxes(frame.detections.boxes[new], frame.noise, self.speed, self.smallest_size)
        arrivals = new_tracks(mean, variance, chance[new], label, frame.reading[new], frame.detections.features[new])
        joined = [np.concatenate([old[keep], fresh]) for old, fresh in zip(tracks, arrivals, strict=True)]
        return BoxTracks(*joined), label + len(new)

    def _judged(self, tracks: BoxTracks, frame: _Frame, confidence: Array, heights: Array) -> tuple[BoxTracks, Array]:
        """Tracks with the probabilities that those with a detection are people, and what their heights teach."""
        found = np.flatnonzero(tracks.missed == 0)
        if len(found) == 0:
            return tracks, heights
        evidence, person, heights = judge_tracks(
            (tracks.mean, tracks.seen, tracks.reading, tracks.readings),
            (tracks.evidence, tracks.person),
            found,
            confidence,
            heights,
            frame.dt,
            self.person,
            self.scores,
            self.heights,
        )
        return tracks._replace(evidence=evidence, person=person), heights

    def _estimate(self, tracks: BoxTracks) -> SetEstimate:
        """Report the people with a detection; hold the others."""
        existence = stated_existence(
            (tracks.existence, tracks.person, tracks.absent, tracks.shares, tracks.seen),
            float(self.coast),
            self.confirm,
            self.established,
            min(LARGEST_HELD, 0.99 * self.report),
        )
        covariances = box_covariances(tracks.variance[:, [0, 3]], tracks.variance[:, 6:])
        return set_of_boxes(center_boxes(tracks.mean), covariances, tracks.label, existence, self.report)

    def _learned_noise(self, state: BoxPMBState, tracks: BoxTracks, found: Mask) -> NoiseScales:
        """Noise of the sequence after the innovations of established tracks."""
        counts = found & (state.tracks.seen >= self.established)
        if self.learning is None or not counts.any():
            return state.noise
        return NoiseScales(
            *learn_noise(*state.noise, tracks.innovation, state.tracks.innovation, counts, self.learning)
        )

    def _learned_appearances(self, tracks: BoxTracks, own: Mask, partner: Labels, features: Array) -> Array:
        """Mean appearances after a frame; only tracks whose detection shows them alone are updated."""
        if features.shape[1] == 0 or not own.any():
            return tracks.appearance
        out = tracks.appearance.copy()
        vectors = np.asarray(features, dtype=np.float64)
        mix_appearances(out, own, partner, vectors, tracks.seen, float(self.appearance_rate))
        return out


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
