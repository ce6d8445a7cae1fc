"""Re-identification after merges and short occlusions, by motion and appearance, on top of any tracker of boxes.

A filter that loses a person and finds the person again gives a new identity, and two people who formed one blob for a
while may leave it with exchanged identities. This layer renames: a new identity takes the name of a recently lost one
if position, size and appearance agree, and two identities that separate after an overlap exchange their names if each
has the appearance of the other. It is causal: earlier estimates do not change.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.boxes.identity_kernel import (
    any_parted,
    find_rivals,
    follow,
    look_up,
    mix_appearances,
    own_appearances,
)
from servotrack.estimators.boxes.merged import SplitRules, split_merged
from servotrack.estimators.boxes.overlap import covered_by
from servotrack.estimators.boxes.report import BoxTracker, checked_detections
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.rfs.sets import HELD, SetEstimate
from servotrack.estimators.types import Array, Labels, Mask

NO_MATCH = 1e3
"""Cost above that of any allowed pair."""


class KnownIdentities(NamedTuple):
    """Memory of k identities.

    Attributes:
        name: Reported identity. Shape (k,).
        inner: The tracker's identity that has this name now. Shape (k,).
        box: Last box. Shape (k, 4), px.
        velocity: Velocity of the center. Shape (k, 2), px per frame.
        appearance: Mean appearance vector of unit length, or zero. Shape (k, F).
        absent: Number of frames since the last report. Shape (k,).
        rival: Name of the identity that it overlaps, or overlapped last and has not separated from; 0 for none. Shape
            (k,).
    """

    name: Labels
    inner: Labels
    box: Array
    velocity: Array
    appearance: Array
    absent: Labels
    rival: Labels


class IdentityState(NamedTuple):
    """State of `KeptIdentities`.

    Attributes:
        tracker: State of the tracker, of the tracker's own type.
        known: Identities that are alive or were lost recently.
        next_name: The next new identity.
    """

    tracker: Any
    known: KnownIdentities
    next_name: int


@dataclass(frozen=True, eq=False)
class KeptIdentities:
    """A tracker of boxes that keeps identities through merges and short occlusions.

    Args:
        tracker: Tracker of boxes whose identities are renamed.
        memory: Number of frames for which a lost identity can return. Raising it joins more tracks, also wrong ones.
        reach: Largest distance from the predicted center at which an identity returns after one frame, heights; it
            grows with the square root of the absence.
        similarity: Smallest similarity of appearance for a return, if both appearances are known. Raising it joins
            fewer tracks.
        merge_overlap: Overlap, as a share of the smaller box, from which two people count as merged.
        margin: Smallest excess of the similarities of exchanged identities over those of kept ones. Raising it
            exchanges fewer.
        split: True to split blobs that cover several known people before the tracker reads them.
        size_change: Largest change of the height at a return, |log(new / old)|.
        appearance_rate: Weight of a new frame in an identity's mean appearance, in (0, 1].
        velocity_rate: Weight of a new frame in an identity's velocity, in (0, 1].
        parted_overlap: Overlap, as a share of the smaller box, up to which merged people count as separated.
        match_distance: Largest distance, one minus overlap, of a reported box to the detection that its appearance is
            taken from.
        split_rules: Conditions under which a blob is split.

    Raises:
        ValueError: An argument is out of range.
    """

    tracker: BoxTracker
    memory: int = 50
    reach: float = 0.3
    similarity: float = 0.7
    merge_overlap: float = 0.3
    margin: float = 0.2
    split: bool = True
    size_change: float = 0.4
    appearance_rate: float = 0.1
    velocity_rate: float = 0.3
    parted_overlap: float = 0.05
    match_distance: float = 0.6
    split_rules: SplitRules = field(default_factory=SplitRules)

    def __post_init__(self) -> None:
        if self.memory < 1 or not self.reach > 0.0 or not 0.0 < self.merge_overlap <= 1.0:
            raise ValueError(
                "memory must be at least 1, reach > 0 and merge_overlap in (0, 1], got "
                f"{self.memory!r}, {self.reach!r}, {self.merge_overlap!r}"
            )
        for name in ("appearance_rate", "velocity_rate"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in (0, 1], got {getattr(self, name)!r}")
        for name in ("size_change", "parted_overlap", "match_distance"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)!r}")

    def initial(self, detections: Detections) -> IdentityState:
        """State before the first frame: no identities."""
        none, features = np.zeros(0, np.int64), checked_detections(detections).features.shape[1]
        known = KnownIdentities(none, none, np.zeros((0, 4)), np.zeros((0, 2)), np.zeros((0, features)), none, none)
        return IdentityState(self.tracker.initial(detections), known, 1)

    def step(
        self, state: IdentityState, detections: Detections, dt: float | None = None
    ) -> tuple[IdentityState, SetEstimate]:
        """Update with the detections of a frame; errors as in the tracker's `step`.

        Args:
            state: State after the last frame.
            detections: Detections of this frame.
            dt: Time since the last frame, s, for trackers whose `step` takes it; None for the nominal one.
        """
        detections = checked_detections(detections, state.known.appearance.shape[1])
        if self.split:
            detections = split_merged(detections, _expected(state.known), self.split_rules)
        passed = () if dt is None else (dt,)
        inner, estimate = self.tracker.step(state.tracker, detections, *passed)
        appearance, seen = self._appearances(estimate.states, detections)
        known, next_name = self._adopt(state.known, estimate, appearance, seen, state.next_name)
        known = self._watch(known, estimate, appearance, seen)
        if appearance.shape[1]:
            known = self._exchange(known, estimate, appearance, seen)
        return IdentityState(inner, known, next_name), self._named(known, estimate)

    def _appearances(self, boxes: Array, detections: Detections) -> tuple[Array, Mask]:
        """Appearance of the detection that each box overlaps most, and mask of known ones. Shapes (k, F) and (k,)."""
        features = detections.features
        if features.shape[1] == 0 or len(features) == 0 or len(boxes) == 0:
            return np.zeros((len(boxes), features.shape[1])), np.zeros(len(boxes), np.bool_)
        distance = box_distances(boxes, detections.boxes)
        return own_appearances(distance, np.ascontiguousarray(features), float(self.match_distance))

    def _named(self, known: KnownIdentities, estimate: SetEstimate) -> SetEstimate:
        """Rename the estimate; all other remembered identities are held."""
        silent = known.absent > 0
        return replace(
            estimate,
            labels=look_up(estimate.labels, known.inner, known.name, 0),
            held_labels=known.name[silent],
            held_states=known.box[silent],
            held_existence=look_up(known.inner[silent], estimate.held_labels, estimate.held_existence, HELD),
        )

    def _adopt(
        self, known: KnownIdentities, estimate: SetEstimate, appearance: Array, seen: Mask, next_name: int
    ) -> tuple[KnownIdentities, int]:
        """Give every new identity of the tracker a name: that of a matching lost identity, else a new one."""
        new = np.flatnonzero(~_among(estimate.labels, known.inner))
        if len(new) == 0:
            return known, next_name
        # An identity that the tracker still holds is not lost: the tracker itself can report it again.
        alive = _among(known.inner, np.concatenate([estimate.labels, estimate.held_labels]))
        lost = np.flatnonzero(~alive & (known.absent < self.memory))
        inner = known.inner.copy()
        taken = np.zeros(len(new), np.bool_)
        if len(lost):
            cost = self._return_costs(known, lost, estimate.states[new], appearance[new], seen[new])
            padded = np.concatenate([cost, np.full((len(lost), len(lost)), 1.0)], axis=1)
            partner = assign(np.ascontiguousarray(padded), len(lost), padded.shape[1])
            back = np.flatnonzero(partner < len(new))
            inner[lost[back]] = estimate.labels[new[partner[back]]]
            taken[partner[back]] = True
        fresh = new[~taken]
        count = len(fresh)
        zeros = np.zeros(count, np.int64)
        arrivals = KnownIdentities(
            next_name + np.arange(count),
            estimate.labels[fresh],
            estimate.states[fresh],
            np.zeros((count, 2)),
            appearance[fresh],
            zeros,
            zeros,
        )
        joined = [np.concatenate([a, b]) for a, b in zip(known._replace(inner=inner), arrivals, strict=True)]
        return KnownIdentities(*joined), next_name + count

    def _return_costs(self, known: KnownIdentities, lost: Labels, boxes: Array, appearance: Array, seen: Mask) -> Array:
        """Cost of matching a lost identity with a new one, below 1 for an allowed match. Shape (lost, new)."""
        absent = known.absent[lost] + 1.0
        old, height = known.box[lost], known.box[lost, 3]
        center = old[:, :2] + old[:, 2:] / 2.0 + known.velocity[lost] * absent[:, None]
        gap = center[:, None] - (boxes[:, :2] + boxes[:, 2:] / 2.0)[None]
        # A box without a height has no reach.
        reach = np.maximum(height, 1e-6) * self.reach * np.sqrt(absent)
        distance = np.sqrt((gap * gap).sum(axis=2)) / reach[:, None]
        size = np.abs(np.log(np.maximum(boxes[None, :, 3], 1.0) / np.maximum(height, 1.0)[:, None]))
        possible = (distance < 1.0) & (size < self.size_change)
        cost = 0.5 * distance + 0.3 * size
        if appearance.shape[1]:
            similar = known.appearance[lost] @ appearance.T
            comparable = np.asarray(known.appearance[lost].any(axis=1))[:, None] & seen[None]
            possible &= ~comparable | (similar >= self.similarity)
            cost += np.where(comparable, 0.4 * (1.0 - similar), 0.0)
        return np.where(possible, cost, NO_MATCH)

    def _watch(self, known: KnownIdentities, estimate: SetEstimate, appearance: Array, seen: Mask) -> KnownIdentities:
        """Update the memory of the reported identities and drop those that were lost for too long."""
        rows, box, velocity, absent = follow(
            known.inner,
            known.box,
            known.velocity,
            known.absent,
            estimate.labels,
            np.ascontiguousarray(estimate.states),
            float(self.velocity_rate),
        )
        here = rows >= 0
        rival = find_rivals(known.name, known.rival, box, here, self.merge_overlap)
        mean = known.appearance
        if appearance.shape[1]:
            mean = mix_appearances(known.appearance, appearance, rows, seen, rival, float(self.appearance_rate))
        keep = (absent <= self.memory) | _among(known.inner, estimate.held_labels)
        after = KnownIdentities(known.name, known.inner, box, velocity, mean, absent, rival)
        return after if keep.all() else KnownIdentities(*[values[keep] for values in after])

    def _exchange(
        self, known: KnownIdentities, estimate: SetEstimate, appearance: Array, seen: Mask
    ) -> KnownIdentities:
        """Exchange the names of rivals that have separated if each has the other's appearance; end their rivalry."""
        parted_overlap = float(self.parted_overlap)
        if not any_parted(known.name, known.inner, known.rival, known.box, estimate.labels, seen, parted_overlap):
            return known
        row_of = {label: row for row, label in enumerate(estimate.labels.tolist())}
        place = {name: k for k, name in enumerate(known.name.tolist())}
        inner, rival = known.inner.copy(), known.rival.copy()
        for k in np.flatnonzero(known.rival > 0).tolist():
            other = place.get(int(rival[k]), -1)
            if other < 0 or rival[k] == 0:
                rival[k] = 0
                continue
            a, b = row_of.get(int(inner[k]), -1), row_of.get(int(inner[other]), -1)
            if a < 0 or b < 0 or not (seen[a] and seen[b]):
                continue
            if _shares(known.box[[k, other]])[0, 1] > parted_overlap:
                continue
            mine, others = known.appearance[k], known.appearance[other]
            kept = float(mine @ appearance[a] + others @ appearance[b])
            crossed = float(mine @ appearance[b] + others @ appearance[a])
            if mine.any() and others.any() and crossed > kept + self.margin:
                inner[k], inner[other] = inner[other], inner[k]
            if rival[other] == known.name[k]:
                rival[other] = 0
            rival[k] = 0
        box = known.box
        if (inner != known.inner).any():
            box = known.box.copy()
            for k in np.flatnonzero(inner != known.inner).tolist():
                box[k] = estimate.states[row_of[int(inner[k])]]
        return known._replace(inner=inner, rival=rival, box=box)


def _among(labels: Labels, others: Labels) -> Mask:
    """Mask of the labels that are among the others; for few labels this is faster than a sort."""
    return (labels[:, None] == others).any(axis=1)


def _expected(known: KnownIdentities) -> Array:
    """Boxes expected in this frame for the identities reported in the last one. Shape (k, 4), px."""
    here = known.absent == 0
    box = known.box[here].copy()
    box[:, :2] += known.velocity[here]
    return box


def _shares(boxes: Array) -> Array:
    """Intersections as shares of the smaller box of each pair. Shape (k, k)."""
    share = covered_by(boxes, boxes)
    return np.maximum(share, share.T)
