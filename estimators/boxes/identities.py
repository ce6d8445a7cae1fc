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
from numpy.typing import NDArray

from servotrack.estimators.boxes.merged import split_merged
from servotrack.estimators.boxes.overlap import covered_by
from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.metrics.distances import box_distances
from servotrack.estimators.rfs.sets import HELD, SetEstimate

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

LOOK_RATE = 0.1
"""Weight of a new frame in an identity's mean appearance."""

SPEED_RATE = 0.3
"""Weight of a new frame in an identity's velocity."""

APART = 0.05
"""Overlap below which two identities have parted."""

NO_MATCH = 1e3
"""Cost beyond that of any allowed pair."""


class Known(NamedTuple):
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
    known: Known
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
        known = Known(none, none, np.zeros((0, 4)), np.zeros((0, 2)), np.zeros((0, features)), none, none)
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

    def _named(self, known: Known, estimate: SetEstimate) -> SetEstimate:
        """The estimate under the names, all others that are remembered being held."""
        name_of = dict(zip(known.inner.tolist(), known.name.tolist(), strict=True))
        existence_of = dict(zip(estimate.held_labels.tolist(), estimate.held_existence.tolist(), strict=True))
        silent = known.absent > 0
        return replace(
            estimate,
            labels=np.array([name_of[label] for label in estimate.labels.tolist()], np.int64),
            held_labels=known.name[silent],
            held_states=known.box[silent],
            held_existence=np.array([existence_of.get(label, HELD) for label in known.inner[silent].tolist()]),
        )

    def _adopt(
        self, known: Known, estimate: SetEstimate, look: Array, seen: NDArray[np.bool_], next_name: int
    ) -> tuple[Known, int]:
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
        arrivals = Known(
            next_name + np.arange(count),
            estimate.labels[fresh],
            estimate.states[fresh],
            np.zeros((count, 2)),
            look[fresh],
            zeros,
            zeros,
        )
        joined = [np.concatenate([a, b]) for a, b in zip(known._replace(inner=inner), arrivals, strict=True)]
        return Known(*joined), next_name + count

    def _return_costs(self, known: Known, lost: Labels, boxes: Array, look: Array, seen: NDArray[np.bool_]) -> Array:
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

    def _watch(self, known: Known, estimate: SetEstimate, look: Array, seen: NDArray[np.bool_]) -> Known:
        """Follow the reported identities; those lost for too long are forgotten."""
        row_of = {label: row for row, label in enumerate(estimate.labels.tolist())}
        rows = np.array([row_of.get(label, -1) for label in known.inner.tolist()], np.int64)
        here = rows >= 0
        box, velocity, mean_look = known.box.copy(), known.velocity.copy(), known.look.copy()
        new = estimate.states[rows[here]]
        moved = (new[:, :2] + new[:, 2:] / 2.0) - (box[here, :2] + box[here, 2:] / 2.0)
        velocity[here] += SPEED_RATE * (moved / (known.absent[here] + 1.0)[:, None] - velocity[here])
        box[here] = new
        rival = self._rivals(known.name, known.rival, box, here)
        if look.shape[1]:
            # While two are merged neither's appearance is its own.
            own = here & (rival == 0)
            own[here] &= seen[rows[here]]
            first = own & ~mean_look.any(axis=1)
            rate = np.where(first, 1.0, LOOK_RATE)[own][:, None]
            mixed = (1.0 - rate) * mean_look[own] + rate * look[rows[own]]
            mean_look[own] = mixed / np.maximum(np.sqrt((mixed * mixed).sum(axis=1, keepdims=True)), 1e-12)
        absent = np.where(here, 0, known.absent + 1)
        keep = (absent <= self.memory) | _among(known.inner, estimate.held_labels)
        after = Known(known.name, known.inner, box, velocity, mean_look, absent, rival)
        return Known(*[values[keep] for values in after])  # type: ignore[arg-type]

    def _rivals(self, name: Labels, rival: Labels, box: Array, here: NDArray[np.bool_]) -> Labels:
        """With whom each identity is merged now, or was and has not parted: then the old rival stays."""
        rows = np.flatnonzero(here)
        if len(rows) < 2 and not rival.any():
            return rival
        share = _shares(box)
        share[:, ~here] = 0.0
        np.fill_diagonal(share, 0.0)
        closest = share.argmax(axis=1)
        overlap = share[np.arange(len(name)), closest]
        merged = here & (overlap >= self.merge_overlap)
        out = rival.copy()
        free = merged & (rival == 0)
        out[free] = name[closest[free]]
        return out

    def _exchange(self, known: Known, estimate: SetEstimate, look: Array, seen: NDArray[np.bool_]) -> Known:
        """Rivals that have parted: exchange their names where they look like each other; then they are no rivals."""
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


def _among(labels: Labels, others: Labels) -> NDArray[np.bool_]:
    """Which labels are among the others; for a handful this is faster than a sort."""
    return (labels[:, None] == others).any(axis=1)


def _expected(known: Known) -> Array:
    """Where those reported in the last frame are expected in this one. Shape (k, 4), px."""
    here = known.absent == 0
    box = known.box[here].copy()
    box[:, :2] += known.velocity[here]
    return box


def _shares(boxes: Array) -> Array:
    """Intersections as shares of the smaller box of each pair. Shape (k, k)."""
    share = covered_by(boxes, boxes)
    return np.maximum(share, share.T)


def _looks(boxes: Array, detections: Detections) -> tuple[Array, NDArray[np.bool_]]:
    """Appearance of the detection each box overlaps most, and whether there is one. Shapes (k, F) and (k,)."""
    features = detections.features
    if features.shape[1] == 0 or len(features) == 0 or len(boxes) == 0:
        return np.zeros((len(boxes), features.shape[1])), np.zeros(len(boxes), np.bool_)
    distance = box_distances(boxes, detections.boxes)
    best = distance.argmin(axis=1)
    seen = distance[np.arange(len(boxes)), best] <= 0.6
    # A detection that two boxes share is a merged blob: nobody's appearance.
    counts = np.bincount(best[seen], minlength=len(features))
    seen &= counts[best] == 1
    seen &= features[best].any(axis=1)
    return np.where(seen[:, None], features[best], 0.0), seen
