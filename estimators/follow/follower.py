"""Tracking of one person among many: a Gaussian-mixture PHD filter of all people in view, and a memory of the target.

All people are tracked, so that detections of other people are assigned to their own tracks. The state of a track is
[u, u', v, v', r, g, b]: position in the image, own motion (without the camera's motion, which the estimate of the image
Jacobian compensates), and color, the appearance that separates people where their paths cross.

A set filter drops people who are not detected for a few frames. The memory keeps the followed identity in the mixture
with a minimum weight, for any number of frames without a detection, while its covariance grows; so the filter itself
detects it again, by position, motion and color. After `search_after` frames only the color decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.follow.ego_motion import EgoMotion
from servotrack.estimators.rfs import GMPHD, HiddenMarkovModel, MeasurementBirth, Reduction
from servotrack.estimators.rfs.phd import PHDState
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Labels, Mask
from servotrack.estimators.validation import LIMITS, as_mask, as_numbers, check_within, first_bad

COLUMNS = 8
"""Columns of a detection: existence; column, row, width, height (px); red, green, blue (gray levels)."""
_SEEN = [0, 1, 2, 5, 6, 7]
"""Columns of a detection that the filter uses: existence, column, row and color."""
_POSITION, _VELOCITY, _COLOR = [0, 2], [1, 3], [4, 5, 6]
"""Entries of the state."""


class FollowState(NamedTuple):
    """State of a `PersonFollower`, B runs.

    Attributes:
        crowd: State of the set filter.
        label: Followed identity. Shape (B,).
        place: Position of the person in the newest frame. Shape (B, 2), px.
        motion: Own velocity of the person in the image. Shape (B, 2), px/s.
        color: Color of the person. Shape (B, 3), gray levels.
        unseen: Number of frames since the last detection of the person. Shape (B,).
        strangers: Labels below this existed while the person was visible, so they belong to other people. Shape (B,).
    """

    crowd: PHDState
    label: Labels
    place: Array
    motion: Array
    color: Array
    unseen: Labels
    strangers: Labels


class Sighting(NamedTuple):
    """Image position of the followed person in a frame.

    Attributes:
        features: Detected position, or the predicted one without a detection. Shape (B, 2), px.
        visible: Mask of the runs with a detection of the person. Shape (B,), bool.
    """

    features: Array
    visible: Mask


@dataclass(frozen=True, eq=False)
class PersonFollower:
    """Follows one person by detections with colors.

    Args:
        period: Time between frames, s.
        acceleration: Root spectral density of people's own acceleration in the image, px/s^1.5. Raising it follows
            turns faster and smooths less.
        position_noise: Standard deviation of a detection's middle, px. Raising it smooths more.
        color_noise: Standard deviation of a detection's color, gray levels.
        color_drift: Standard deviation of the change of a person's color per frame, gray levels.
        speed: Standard deviation of a new person's velocity, px/s.
        detection: Probability that a person in view is detected.
        survival: Probability that a person stays in view from frame to frame.
        births: Expected number of people who appear per frame.
        clutter: Expected number of false detections per frame.
        first_color: Standard deviation of the color in the first picture, gray levels.
        least_weight: Minimum weight of the followed identity. Raising it assigns nearby detections to it sooner.
        near: Largest distance of a detection to the person's track, and smallest distance of two people, px.
        alike: Largest distance of two colors of the same person, gray levels. Raising it finds the person again more
            often, and confuses people of similar color.
        spreading: Growth of `near` for new tracks while the person is not detected, px/s.
        search_after: Number of frames without a detection after which any new track of that color may be the person.
        memory: Time constant in which the velocity of an undetected person falls, s.
        reduction: Pruning, merging and capping of the filter's mixture.
        image_width: Width of the square image in whose pixels all lengths are given, px.
        color_rate: Weight of a new frame in the person's color.
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
    search_after: int = 30
    memory: float = 0.4
    reduction: Reduction = field(default_factory=lambda: Reduction(components=40))
    image_width: float = 480.0
    color_rate: float = 0.05

    @cached_property
    def filter(self) -> GMPHD:
        """The filter of all people in view."""
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
            clutter_intensity=self.clutter / (self.image_width**2 * 255.0**3),
            survival=self.survival,
            detection=self.detection,
            reduction=self.reduction,
        )

    @cached_property
    def _spread(self) -> Array:
        """Covariance of a person with a first picture only."""
        return np.diag([self.position_noise**2, self.speed**2] * 2 + [self.first_color**2] * 3)

    @cached_property
    def _rules(self) -> _Rules:
        slowing = float(np.exp(-self.period / self.memory))
        return _Rules(
            self.near,
            self.alike,
            self.least_weight,
            slowing,
            self.spreading * self.period,
            self.search_after,
            self.color_rate,
            self._spread,
        )

    def initial(self, detections: Array, place: Array, color: Array) -> FollowState:
        """State before the update with the first frame.

        Colors in a picture differ from those of a detector, so a detection near the given position replaces the color.

        Args:
            detections: Detections of that frame. Shape (B, M, COLUMNS).
            place: Middle of the person in that frame. Shape (B, 2), px.
            color: Color of the person. Shape (B, 3), gray levels.

        Raises:
            ValueError: An argument has a wrong shape, is not finite or is beyond
                `servotrack.estimators.validation.LIMITS`.
        """
        detections = checked(detections)
        runs = (len(detections),)
        place = checked_rows("place", place, (*runs, 2), LIMITS.pixels)
        color = checked_rows("color", color, (*runs, 3), LIMITS.pixels).copy()
        crowd = self.filter.initial(detections[:, :, _SEEN])
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
        """Update with one frame, in the runs that have a new one.

        Args:
            state: Result of `initial` or of the last `step`.
            detections: Detections of the frame. Shape (B, M, COLUMNS).
            fresh: Mask of the runs with a new frame. Shape (B,), bool.
            elapsed: Time since the last frame. Shape (B,), s.
            ego_motion: Predicted motion of points at rest in the image.
            joints_before: Joint angles at the last frame. Shape (B, n), rad.
            joints_after: Joint angles at this frame. Shape (B, n), rad.

        Returns:
            The new state, and the image position of the person.

        Raises:
            ValueError: An argument has a wrong shape, is not finite or is beyond
                `servotrack.estimators.validation.LIMITS`. Rows of detections with existence 0 may hold any values.
        """
        detections = checked(detections)
        runs = state.label.shape
        if detections.shape[:1] != runs:
            raise ValueError(
                f"detections must be of the state's {runs[0]} runs, got {len(detections)}; make a new state with "
                "initial(detections, place, color)"
            )
        fresh = as_mask("fresh", fresh)
        if fresh.shape != runs:
            raise ValueError(f"fresh must have shape {runs}, got {fresh.shape}; pass one truth value per run")
        elapsed = checked_rows("elapsed", elapsed, runs, LIMITS.times)
        joints_before = as_numbers("joints_before", joints_before)
        joints = (max(joints_before.shape[-1], 1),) if joints_before.ndim == 2 else (1,)
        joints_before = checked_rows("joints_before", joints_before, (*runs, *joints), LIMITS.angles)
        joints_after = checked_rows("joints_after", joints_after, (*runs, *joints), LIMITS.angles)
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
        newborn = moved.crowd.next_label
        reported = estimate.labels, estimate.states
        _decide(detections, reported, crowd.intensity, new[1:], newborn, self._rules, features, visible)
        kept = select_rows(fresh, new, state)
        return kept, Sighting(np.where(fresh[:, None], features, state.place), visible & fresh)

    def _carried(
        self, state: FollowState, elapsed: Array, ego_motion: EgoMotion, joints_before: Array, joints_after: Array
    ) -> FollowState:
        """Compensate the camera's motion in positions and velocities; the filter's prediction adds the own motion."""
        intensity, births = state.crowd.intensity, state.crowd.births
        mean, born = intensity.mean.copy(), births.mean.copy()
        place, motion = state.place[:, None], state.motion[:, None]
        known = mean.shape[1]
        position = np.concatenate([mean[..., _POSITION], born[..., _POSITION], place], axis=1)
        velocity = np.concatenate([mean[..., _VELOCITY], born[..., _VELOCITY], motion], axis=1)
        here = ego_motion(position, joints_before, joints_after)
        ahead = ego_motion(position + self.period * velocity, joints_before, joints_after)
        turned = (ahead - here) / self.period
        # The filter itself predicts for one period; after a lost frame the rest is added here.
        here = here + (elapsed[:, None, None] - self.period) * turned
        mean[..., _POSITION], mean[..., _VELOCITY] = here[:, :known], turned[:, :known]
        born[..., _POSITION], born[..., _VELOCITY] = here[:, known:-1], turned[:, known:-1]
        crowd = state.crowd._replace(intensity=intensity._replace(mean=mean), births=births._replace(mean=born))
        return state._replace(crowd=crowd, place=here[:, -1] + self.period * turned[:, -1], motion=turned[:, -1])


class _Rules(NamedTuple):
    """Parameters of a `PersonFollower` for the compiled kernels, per frame where they are rates.

    Attributes:
        near, alike, least_weight, search_after, color_rate: Parameters of the same names.
        slowing: Factor on the velocity of an undetected person.
        spreading: Growth of `near`, px.
        spread: Covariance of a person with a first picture only. Shape (7, 7).
    """

    near: float
    alike: float
    least_weight: float
    slowing: float
    spreading: float
    search_after: int
    color_rate: float
    spread: Array


def checked(detections: Array) -> Array:
    """Return the detections as a float64 array; raise ValueError for a wrong shape or bad values in used rows."""
    table = as_numbers("detections", detections)
    if table.ndim != 3 or table.shape[2] != COLUMNS:
        raise ValueError(
            f"detections must have shape (runs, rows, {COLUMNS}): existence, column, row, width, height, red, green, "
            f"blue; got {table.shape}"
        )
    existence = table[..., 0]
    bad = ~((existence == 0.0) | (existence == 1.0))
    if bad.any():
        raise ValueError(
            f"detections must have existence 0 or 1 in column 0, got {first_bad(existence, bad)}; set unused rows to 0"
        )
    used = existence[..., None] == 1.0
    check_within("detections", table, LIMITS.pixels, "set the existence of the row to 0", used)
    return table


def checked_rows(name: str, value: ArrayLike, shape: tuple[int, ...], limit: float) -> Array:
    """Convert an argument with one row per run; raise ValueError for a wrong shape or bad values."""
    array = as_numbers(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}; pass one row per run of the state")
    check_within(name, array, limit, "repeat the last good value instead")
    return array


@njit(cache=True, nogil=True)
def _nearest(detections, u, v, color, reach, alike):  # type: ignore[no-untyped-def]
    """Index of the detection nearest to (u, v) within `reach` px and of similar color; -1 for none."""
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
    detections, reported, intensity, memory, newborn, rules, features, visible
):
    """Keep the followed identity alive in every run.

    Args:
        detections: Detections of the frame. Shape (B, M, COLUMNS).
        reported: Reported identities and states. Shapes (B, k) and (B, k, 7).
        intensity: Mixture of the set filter; changed.
        memory: Fields of a `FollowState` from `label` on; changed.
        newborn: Identities from this one on are new in this frame. Shape (B,).
        rules: A `_Rules`.
        features: Output as in `Sighting`. Shape (B, 2).
        visible: Output as in `Sighting`. Shape (B,).
    """
    labels, states = reported
    label, place, motion, color, unseen, strangers = memory
    number, weight, mean, covariance = intensity.number, intensity.weight, intensity.mean, intensity.covariance
    identity = intensity.label
    near, alike, least, slowing, spreading, search_after, color_rate, spread = rules
    for b in range(label.shape[0]):
        if unseen[b] > 0:
            # The distance is limited until the person may be anywhere.
            reach = near + spreading * unseen[b] if unseen[b] < search_after else np.inf
            found = _recognized(labels[b], states[b], place[b], color[b], strangers[b], reach, alike)
            if found >= 0:
                label[b] = labels[b, found]
        row = -1
        for k in range(number[b]):
            if identity[b, k] == label[b] and (row < 0 or weight[b, k] > weight[b, row]):
                row = k
        if row < 0:
            # The component was merged into another one or capped: it is restored at its predicted position.
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
                color[b, channel] += color_rate * (mean[b, row, 4 + channel] - color[b, channel])
            for k in range(number[b]):
                # No other person can be this near: a track born here is a second track of the person.
                away = (mean[b, k, 0] - place[b, 0]) ** 2 + (mean[b, k, 2] - place[b, 1]) ** 2
                if identity[b, k] >= newborn[b] and away < near * near:
                    identity[b, k] = label[b]
        else:
            for axis in range(2):
                mean[b, row, 2 * axis + 1] *= slowing
                motion[b, axis] *= slowing


@njit(cache=True, nogil=True)
def _recognized(labels, states, place, color, strangers, reach, alike):  # type: ignore[no-untyped-def]
    """Index of the nearest reported track of similar color that began after the person was lost; -1 for none."""
    best, found = reach * reach, -1
    for k in range(labels.shape[0]):
        off = 0.0
        for channel in range(3):
            off += (states[k, 4 + channel] - color[channel]) ** 2
        away = (states[k, 0] - place[0]) ** 2 + (states[k, 2] - place[1]) ** 2
        if labels[k] >= strangers and off < alike * alike and away < best:
            best, found = away, k
    return found
