"""Identities kept through merges and short occlusions: a layer over any tracker of boxes, by motion and appearance.

A filter that loses a person and finds the person again gives a new identity; a filter whose two people were one blob
for a while may hand their identities over crosswise. This layer renames: it takes a new identity for one that was
lost a moment ago where place, size and appearance agree, and it exchanges two identities that parted from an overlap
each looking like the other. It is causal: what was reported is not changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.boxes.identity_kernel import (
    APART,
    any_parted,
    find_rivals,
    follow,
    look_up,
    mix_looks,
    own_looks,
)
from servotrack.estimators.boxes.merged import split_merged
from servotrack.estimators.boxes.overlap import covered_by
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.rfs.sets import HELD, SetEstimate
from servotrack.estimators.types import Array, Labels, Mask

NO_MATCH = 1e3
"""Cost beyond that of any allowed pair."""


class KnownIdentities(NamedTuple):
    """What is remembered of k identities.

    Attributes:
        name: As reported. Shape (k,).
        inner: The tracker's identity that bears the name now. Shape (k,).
        box: Last box. Shape (k, 4), px.
        velocity: Of the center. Shape (k, 2), px per frame.
        look: Mean appearance, of unit length, or zero. Shape (k, F).
        absent: Frames since last reported. Shape (k,).
        rival: Name of the identity it overlaps, or overlapped last and has not parted from; 0 for none. Shape (k,).
    """

    name: Labels
    inner: Labels
    box: Array
    velocity: Array
    look: Array
    absent: Labels
    rival: Labels


class IdentityState(NamedTuple):
    """State of `KeptIdentities`.

    Attributes:
        tracker: The tracker's.
        known: Identities alive or lost a moment ago.
        next_name: The next new identity.
    """

    tracker: Any
    known: KnownIdentities
    next_name: int


@dataclass(frozen=True, eq=False)
class KeptIdentities:
    """A tracker of boxes whose identities are kept through merges and short occlusions.

    Args:
        tracker: Anything with `initial(detections)` and `step(state, detections)` that reports boxes.
        memory: Frames for which a lost identity can return.
        reach: How far from its predicted place it may return, heights; grows with the square root of the absence.
        similarity: Least similarity of appearance, where there is one.
        merge_overlap: Share of the smaller box from which two people count as merged.
        margin: By how much the similarities of exchanged identities must exceed those of kept ones.
        split: Whether the tracker is given blobs that cover several known people taken apart.

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    tracker: Any
    memory: int = 50
    reach: float = 0.3
    similarity: float = 0.7
    merge_overlap: float = 0.3
    margin: float = 0.2
    split: bool = True

    def __post_init__(self) -> None:
        if self.memory < 1 or not self.reach > 0.0 or not 0.0 < self.merge_overlap <= 1.0:
            raise ValueError(
                "memory must be at least 1, reach > 0 and merge_overlap in (0, 1], got "
                f"{self.memory!r}, {self.reach!r}, {self.merge_overlap!r}"
            )

    def initial(self, detections: Detections) -> IdentityState:
        """State before the first frame: nobody is known."""
        none, features = np.zeros(0, np.int64), detections.features.shape[1]
        known = KnownIdentities(none, none, np.zeros((0, 4)), np.zeros((0, 2)), np.zeros((0, features)), none, none)
        return IdentityState(self.tracker.initial(detections), known, 1)

    def step(self, state: IdentityState, detections: Detections) -> tuple[IdentityState, SetEstimate]:
        """Fold a frame's detections in; errors as the tracker's."""
        if self.split:
            detections = split_merged(detections, _expected(state.known))
        inner, estimate = self.tracker.step(state.tracker, detections)
        look, seen = _looks(estimate.states, detections)
        known, next_name = self._adopt(state.known, estimate, look, seen, state.next_name)
        known = self._watch(known, estimate, look, seen)
        if look.shape[1]:
            known = self._exchange(known, estimate, look, seen)
        return IdentityState(inner, known, next_name), self._named(known, estimate)

    def _named(self, known: KnownIdentities, estimate: SetEstimate) -> SetEstimate:
        """The estimate under the names, all others that are remembered being held."""
        silent = known.absent > 0
        return replace(
            estimate,
            labels=look_up(estimate.labels, known.inner, known.name, 0),
            held_labels=known.name[silent],
            held_states=known.box[silent],
            held_existence=look_up(known.inner[silent], estimate.held_labels, estimate.held_existence, HELD),
        )

    def _adopt(
        self, known: KnownIdentities, estimate: SetEstimate, look: Array, seen: Mask, next_name: int
    ) -> tuple[KnownIdentities, int]:
        """Give every new identity of the tracker a name: that of a lost one where all agrees, else a new one."""
        new = np.flatnonzero(~_among(estimate.labels, known.inner))
        if len(new) == 0:
            return known, next_name
        # Who is still held by the tracker is not lost: it can come back by itself.
        alive = _among(known.inner, np.concatenate([estimate.labels, estimate.held_labels]))
        lost = np.flatnonzero(~alive & (known.absent < self.memory))
        inner = known.inner.copy()
        taken = np.zeros(len(new), np.bool_)
        if len(lost):
            cost = self._return_costs(known, lost, estimate.states[new], look[new], seen[new])
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
            look[fresh],
            zeros,
            zeros,
        )
        joined = [np.concatenate([a, b]) for a, b in zip(known._replace(inner=inner), arrivals, strict=True)]
        return KnownIdentities(*joined), next_name + count

    def _return_costs(self, known: KnownIdentities, lost: Labels, boxes: Array, look: Array, seen: Mask) -> Array:
        """Cost of a lost identity being a new one, below 1 where possible. Shape (lost, new)."""
        absent = known.absent[lost] + 1.0
        old, height = known.box[lost], known.box[lost, 3]
        center = old[:, :2] + old[:, 2:] / 2.0 + known.velocity[lost] * absent[:, None]
        gap = center[:, None] - (boxes[:, :2] + boxes[:, 2:] / 2.0)[None]
        distance = np.sqrt((gap * gap).sum(axis=2)) / (height * self.reach * np.sqrt(absent))[:, None]
        size = np.abs(np.log(np.maximum(boxes[None, :, 3], 1.0) / np.maximum(height, 1.0)[:, None]))
        possible = (distance < 1.0) & (size < 0.4)
        cost = 0.5 * distance + 0.3 * size
        if look.shape[1]:
            similar = known.look[lost] @ look.T
            comparable = np.asarray(known.look[lost].any(axis=1))[:, None] & seen[None]
            possible &= ~comparable | (similar >= self.similarity)
            cost += np.where(comparable, 0.4 * (1.0 - similar), 0.0)
        return np.where(possible, cost, NO_MATCH)

    def _watch(self, known: KnownIdentities, estimate: SetEstimate, look: Array, seen: Mask) -> KnownIdentities:
        """Follow the reported identities; those lost for too long are forgotten."""
        rows, box, velocity, absent = follow(
            known.inner, known.box, known.velocity, known.absent, estimate.labels, np.ascontiguousarray(estimate.states)
        )
        here = rows >= 0
        rival = find_rivals(known.name, known.rival, box, here, self.merge_overlap)
        mean_look = known.look
        if look.shape[1]:
            mean_look = mix_looks(known.look, look, rows, seen, rival)
        keep = (absent <= self.memory) | _among(known.inner, estimate.held_labels)
        after = KnownIdentities(known.name, known.inner, box, velocity, mean_look, absent, rival)
        return after if keep.all() else KnownIdentities(*[values[keep] for values in after])

    def _exchange(self, known: KnownIdentities, estimate: SetEstimate, look: Array, seen: Mask) -> KnownIdentities:
        """Rivals that have parted: exchange their names where they look like each other; then they are no rivals."""
        if not any_parted(known.name, known.inner, known.rival, known.box, estimate.labels, seen):
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
            if _shares(known.box[[k, other]])[0, 1] > APART:
                continue
            kept = float(known.look[k] @ look[a] + known.look[other] @ look[b])
            crossed = float(known.look[k] @ look[b] + known.look[other] @ look[a])
            if known.look[k].any() and known.look[other].any() and crossed > kept + self.margin:
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
    """Which labels are among the others; for a handful this is faster than a sort."""
    return (labels[:, None] == others).any(axis=1)


def _expected(known: KnownIdentities) -> Array:
    """Where those reported in the last frame are expected in this one. Shape (k, 4), px."""
    here = known.absent == 0
    box = known.box[here].copy()
    box[:, :2] += known.velocity[here]
    return box


def _shares(boxes: Array) -> Array:
    """Intersections as shares of the smaller box of each pair. Shape (k, k)."""
    share = covered_by(boxes, boxes)
    return np.maximum(share, share.T)


def _looks(boxes: Array, detections: Detections) -> tuple[Array, Mask]:
    """Appearance of the detection each box overlaps most, and whether there is one. Shapes (k, F) and (k,)."""
    features = detections.features
    if features.shape[1] == 0 or len(features) == 0 or len(boxes) == 0:
        return np.zeros((len(boxes), features.shape[1])), np.zeros(len(boxes), np.bool_)
    return own_looks(box_distances(boxes, detections.boxes), np.ascontiguousarray(features))
