"""One person among many: a Gaussian-mixture PHD filter of everybody in view, and a memory of whom to follow.

Everybody is tracked, so that a detection which belongs to somebody else is known to be theirs. A target's state is
[u, u', v, v', r, g, b]: where it is in the image, how it moves by itself (the camera's own motion is taken out by what
the Jacobian's estimator believes), and its color, the appearance that tells people apart where they cross.

A set filter forgets who is not detected within a few frames. The memory does not: the followed identity is kept in the
mixture with a least weight, however long nobody is detected there, and spreads with the uncertainty of where the person
went; so the filter itself takes it up again, by place, motion and color. Only after a while the color alone decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

from servotrack.estimators.follow.ego_motion import EgoMotion
from servotrack.estimators.rfs import GMPHD, HiddenMarkovModel, MeasurementBirth, Reduction
from servotrack.estimators.rfs.phd import PHDState
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Labels, Mask

COLUMNS = 8
"""Of a detection: existence; column, row, width, height (px); red, green, blue (gray levels)."""
_SEEN = [0, 1, 2, 5, 6, 7]
_POSITION, _VELOCITY, _COLOR = [0, 2], [1, 3], [4, 5, 6]
_IMAGE = 480.0  # width of the image in whose pixels all numbers are, px


class FollowState(NamedTuple):
    """State of a `PersonFollower`, B runs.

    Attributes:
        crowd: The set filter's state.
        label: Identity that is followed. Shape (B,).
        place: Where the person is in the newest frame. Shape (B, 2), px.
        motion: Their own motion in it. Shape (B, 2), px/s.
        color: Shape (B, 3), gray levels.
        unseen: Frames since the person was last detected. Shape (B,).
        strangers: Identities below this one were there beside the person: they are others. Shape (B,).
    """

    crowd: PHDState
    label: Labels
    place: Array
    motion: Array
    color: Array
    unseen: Labels
    strangers: Labels


class Sighting(NamedTuple):
    """What a frame tells of the person to follow.

    Attributes:
        features: Where they were detected, or else where they are believed to be. Shape (B, 2), px.
        visible: Whether they were detected. Shape (B,), bool.
    """

    features: Array
    visible: Mask


@dataclass(frozen=True, eq=False)
class PersonFollower:
    """Follows one person by detections with colors.

    Args:
        period: Between frames, s.
        acceleration: Root spectral density of people's own acceleration in the image, px/s^1.5.
        position_noise: Standard deviation of a detection's middle, px.
        color_noise: Standard deviation of a detection's color, gray levels.
        color_drift: The same of a person's color from frame to frame.
        speed: Standard deviation of the velocity of who appears, px/s.
        detection: Probability of a person in view to be detected.
        survival: Probability to stay in view from frame to frame.
        births: Expected number of people who appear per frame.
        clutter: Expected number of false detections per frame.
        first_color: Standard deviation of the color that the first picture shows, gray levels.
        least_weight: That the followed identity keeps.
        near: Distance at which a detection is that of the person's track, and at which nobody else can be, px.
        alike: Distance of colors at which two may be the same person, gray levels.
        spreading: By how much that distance grows for new tracks while the person is not detected, px/s.
        patience: Frames without a detection after which any new track of that color may be the person.
        memory: Time over which somebody who is not detected is expected to stop or turn, s.
        reduction: How far the filter's mixture is reduced.
    """

    period: float = 0.05
    acceleration: float = 60.0
    position_noise: float = 5.0
    color_noise: float = 11.0
    color_drift: float = 0.5
    speed: float = 60.0
    detection: float = 0.93
    survival: float = 0.99
    births: float = 0.05
    clutter: float = 1.5
    first_color: float = 30.0
    least_weight: float = 0.2
    near: float = 25.0
    alike: float = 25.0
    spreading: float = 60.0
    patience: int = 30
    memory: float = 0.4
    reduction: Reduction = field(default_factory=lambda: Reduction(components=40))

    @cached_property
    def filter(self) -> GMPHD:
        """The filter of everybody in view."""
        t, q = self.period, self.acceleration**2
        F, Q = np.eye(7), np.zeros((7, 7))
        for axis in (0, 2):
            F[axis, axis + 1] = t
            Q[axis : axis + 2, axis : axis + 2] = q * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
        Q[_COLOR, _COLOR] = self.color_drift**2
        R = np.diag([self.position_noise**2] * 2 + [self.color_noise**2] * 3)
        model = HiddenMarkovModel(F, Q, np.eye(7)[[*_POSITION, *_COLOR]], R)
        return GMPHD(
            model,
            MeasurementBirth(expected=self.births, hidden_deviation=self.speed),
            clutter_intensity=self.clutter / (_IMAGE**2 * 255.0**3),
            survival=self.survival,
            detection=self.detection,
            reduction=self.reduction,
        )

    @cached_property
    def _spread(self) -> Array:
        """Covariance of a person of whom nothing but a first picture is known."""
        return np.diag([self.position_noise**2, self.speed**2] * 2 + [self.first_color**2] * 3)

    @cached_property
    def _limits(self) -> tuple[float, ...]:
        slowing = float(np.exp(-self.period / self.memory))
        return self.near, self.alike, self.least_weight, slowing, self.spreading * self.period

    def initial(self, detections: Array, place: Array, color: Array) -> FollowState:
        """State before the first frame is folded in.

        A picture shows other shades than a detector: a detection at the place in question tells the color better.

        Args:
            detections: Of that frame. Shape (B, M, COLUMNS).
            place: Middle of the person in it. Shape (B, 2), px.
            color: Their color. Shape (B, 3), gray levels.
        """
        crowd = self.filter.initial(checked(detections)[:, :, _SEEN])
        color = color.copy()
        for run, (table, middle) in enumerate(zip(detections, place, strict=True)):
            found = _nearest(table, middle[0], middle[1], color[run], self.near, 2.0 * self.first_color)
            if found >= 0:
                color[run] = table[found, 5:]
        intensity, n = crowd.intensity, 7
        intensity.number[:] = 1
        intensity.weight[:, 0], intensity.label[:, 0] = 0.98, 1
        intensity.mean[:, 0, _POSITION], intensity.mean[:, 0, _COLOR] = place, color
        intensity.covariance[:, 0, :n, :n] = self._spread
        count = len(place)
        one = np.ones(count, np.int64)
        return FollowState(
            crowd._replace(next_label=one + 1),
            one,
            place.copy(),
            np.zeros((count, 2)),
            color,
            np.zeros(count, np.int64),
            one + 1,
        )

    def step(
        self,
        state: FollowState,
        detections: Array,
        fresh: Mask,
        elapsed: Array,
        ego_motion: EgoMotion,
        joints_before: Array,
        joints_after: Array,
    ) -> tuple[FollowState, Sighting]:
        """Fold one frame in, of those runs that have a new one.

        Args:
            state: As returned by `initial` or `step`.
            detections: Shape (B, M, COLUMNS).
            fresh: Which runs have a new frame. Shape (B,), bool.
            elapsed: Time since the last frame. Shape (B,), s.
            ego_motion: Where points at rest go.
            joints_before: Joint angles at the last frame. Shape (B, n), rad.
            joints_after: Joint angles at this one. Shape (B, n), rad.

        Returns:
            The new state, and what the frame tells of the person.

        Raises:
            ValueError: As the set filter does for detections of a wrong shape or not finite.
        """
        checked(detections)
        moved = self._carried(state, elapsed, ego_motion, joints_before, joints_after)
        crowd, estimate = self.filter.step(moved.crowd, np.ascontiguousarray(detections[:, :, _SEEN]))
        new = moved._replace(
            crowd=crowd,
            label=moved.label.copy(),
            color=moved.color.copy(),
            unseen=moved.unseen.copy(),
            strangers=np.where(moved.unseen == 0, crowd.next_label, moved.strangers),
        )
        features, visible = new.place.copy(), np.zeros(len(fresh), np.bool_)
        _decide(  # type: ignore[call-arg]  # mypy cannot count starred arguments of a compiled function
            detections, estimate.labels, estimate.states, *crowd.intensity[:4], crowd.intensity.label, *new[1:],
            features, visible, self._spread, self._limits, self.patience, moved.crowd.next_label,
        )  # fmt: skip
        kept = select_rows(fresh, new, state)
        return kept, Sighting(np.where(fresh[:, None], features, state.place), visible & fresh)

    def _carried(
        self, state: FollowState, elapsed: Array, ego_motion: EgoMotion, joints_before: Array, joints_after: Array
    ) -> FollowState:
        """Everybody where they would be if they had not moved by themselves for the filter's own period."""
        intensity, births = state.crowd.intensity, state.crowd.births
        mean, born = intensity.mean.copy(), births.mean.copy()
        place, motion = state.place[:, None], state.motion[:, None]
        known = mean.shape[1]
        position = np.concatenate([mean[..., _POSITION], born[..., _POSITION], place], axis=1)
        velocity = np.concatenate([mean[..., _VELOCITY], born[..., _VELOCITY], motion], axis=1)
        here = ego_motion(position, joints_before, joints_after)
        ahead = ego_motion(position + self.period * velocity, joints_before, joints_after)
        turned = (ahead - here) / self.period
        # The filter itself goes on for one period; a lost frame leaves more.
        here = here + (elapsed[:, None, None] - self.period) * turned
        mean[..., _POSITION], mean[..., _VELOCITY] = here[:, :known], turned[:, :known]
        born[..., _POSITION], born[..., _VELOCITY] = here[:, known:-1], turned[:, known:-1]
        crowd = state.crowd._replace(intensity=intensity._replace(mean=mean), births=births._replace(mean=born))
        return state._replace(crowd=crowd, place=here[:, -1] + self.period * turned[:, -1], motion=turned[:, -1])


def checked(detections: Array) -> Array:
    """The detections, if they are a table for each run; raises ValueError that says what would be."""
    if np.ndim(detections) != 3 or detections.shape[2] != COLUMNS:
        raise ValueError(
            f"detections must have shape (runs, rows, {COLUMNS}): existence, column, row, width, height, red, green, "
            f"blue; got {np.shape(detections)}"
        )
    return detections


@njit(cache=True, nogil=True)
def _nearest(detections, u, v, color, reach, alike):  # type: ignore[no-untyped-def]
    """The detection nearest to (u, v) within `reach` px, of about this color; -1 for none."""
    best, found = reach * reach, -1
    for k in range(detections.shape[0]):
        if detections[k, 0] < 0.5:
            continue
        distance = (detections[k, 1] - u) ** 2 + (detections[k, 2] - v) ** 2
        off = 0.0
        for channel in range(3):
            off += (detections[k, 5 + channel] - color[channel]) ** 2
        if distance < best and off < alike * alike:
            best, found = distance, k
    return found


@njit(cache=True, nogil=True)
def _decide(  # type: ignore[no-untyped-def]
    detections, labels, states, number, weight, mean, covariance, identity, label, place, motion, color, unseen,
    strangers, features, visible, spread, limits, patience, newborn,
):  # fmt: skip
    """Keep the followed identity alive in every run; fill the memory, `features` and `visible`."""
    near, alike, least, slowing, spreading = limits
    for b in range(label.shape[0]):
        if unseen[b] > 0:
            # Only near, until there has been time to go anywhere.
            reach = near + spreading * unseen[b] if unseen[b] < patience else np.inf
            found = _recognized(labels[b], states[b], place[b], color[b], strangers[b], reach, alike)
            if found >= 0:
                label[b] = labels[b, found]
        row = -1
        for k in range(number[b]):
            if identity[b, k] == label[b] and (row < 0 or weight[b, k] > weight[b, row]):
                row = k
        if row < 0:
            # It was merged into somebody else's or cut off: it comes back where it is believed to be.
            row = min(number[b], weight.shape[1] - 1)
            number[b] = row + 1
            identity[b, row] = label[b]
            weight[b, row] = 0.0
            mean[b, row] = 0.0
            covariance[b, row] = 0.0
            covariance[b, row, : spread.shape[0], : spread.shape[1]] = spread
            for axis in range(2):
                mean[b, row, 2 * axis], mean[b, row, 2 * axis + 1] = place[b, axis], motion[b, axis]
            for channel in range(3):
                mean[b, row, 4 + channel] = color[b, channel]
        weight[b, row] = max(weight[b, row], least)
        for axis in range(2):
            place[b, axis], motion[b, axis] = mean[b, row, 2 * axis], mean[b, row, 2 * axis + 1]
        unseen[b] += 1
        found = _nearest(detections[b], place[b, 0], place[b, 1], mean[b, row, 4:7], near, 2.0 * alike)
        features[b] = place[b]
        if found >= 0:
            unseen[b], visible[b] = 0, True
            features[b, 0], features[b, 1] = detections[b, found, 1], detections[b, found, 2]
            for channel in range(3):
                color[b, channel] += 0.05 * (mean[b, row, 4 + channel] - color[b, channel])
            for k in range(number[b]):
                # Nobody else can stand so near: what is born here is a second track of the person.
                away = (mean[b, k, 0] - place[b, 0]) ** 2 + (mean[b, k, 2] - place[b, 1]) ** 2
                if identity[b, k] >= newborn[b] and away < near * near:
                    identity[b, k] = label[b]
        else:
            for axis in range(2):
                mean[b, row, 2 * axis + 1] *= slowing
                motion[b, axis] *= slowing


@njit(cache=True, nogil=True)
def _recognized(labels, states, place, color, strangers, reach, alike):  # type: ignore[no-untyped-def]
    """The nearest reported track of the person's color that is new since they were lost; -1 for none."""
    best, found = reach * reach, -1
    for k in range(labels.shape[0]):
        off = 0.0
        for channel in range(3):
            off += (states[k, 4 + channel] - color[channel]) ** 2
        away = (states[k, 0] - place[0]) ** 2 + (states[k, 2] - place[1]) ** 2
        if labels[k] >= strangers and off < alike * alike and away < best:
            best, found = away, k
    return found
