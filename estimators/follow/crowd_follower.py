"""Following one person of a crowd: tracks of all people, and several hypotheses about which of them is the person.

Every person in view has a track, with a probability that the person exists and one that something covers them. The
followed person has hypotheses of their own, each with a motion, a color and the track that it takes for the person. A
frame splits each hypothesis into "missed" and one for each detection, and a detection counts against what else
explains it: the tracks of the others, people who appear, and clutter (a Bernoulli filter in the clutter of the others:
Ristic, Vo, Vo and Farina, "A tutorial on Bernoulli filters", IEEE Trans. Signal Processing 61(13), 2013). Which of two
people who met is the right one is therefore decided when their colors and motions tell, not when they meet.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotrack.estimators.follow.crowd_kernel import follow_crowd
from servotrack.estimators.follow.crowd_people import CrowdMemory, CrowdRules, People
from servotrack.estimators.follow.ego_motion import EgoMotion
from servotrack.estimators.follow.follower import Sighting, checked, checked_rows
from servotrack.estimators.stateful import copied
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import LIMITS, as_mask


class CrowdState(NamedTuple):
    """State of a `CrowdFollower`, B runs.

    Attributes:
        crowd: Tracks of all people.
        guesses: Hypotheses of the person to follow.
        memory: Color, place and counters beside them.
    """

    crowd: People
    guesses: People
    memory: CrowdMemory

    @property
    def place(self) -> Array:
        """Position of the person in the newest frame. Shape (B, 2), px."""
        return self.memory.place


@dataclass(frozen=True)
class CrowdFollower:
    """Follows one person by detections with colors and sizes, with several hypotheses.

    All rates are per second and all lengths in widths of a person, so that one setting serves every camera.

    Args:
        acceleration: Root spectral density of the person's acceleration between turns, widths/s^1.5. Raising it
            follows slow turns sooner and smooths less.
        crowd_acceleration: The same for the tracks of all people, which have no hypotheses of turns.
        speed: Standard deviation of a person's velocity along each axis after a turn, widths/s.
        position_noise: Standard deviation of a detection's middle, px.
        color_noise: Standard deviation of a detection's color, gray levels.
        color_drift: Standard deviation of the change of a person's color per frame, gray levels.
        size_noise: Standard deviation of the logarithm of a detection's width and height.
        detection: Probability that a person in view is detected who is neither covered nor near another one.
        births: Expected number of people who appear per frame.
        hide_rate: Number of times that a person disappears under something that is not tracked, per width walked.
        show_rate: Number of times that such a person appears again, per width walked. Raising it gives up hidden people
            sooner who walk.
        uncover_rate: The same for people who stand, 1/s.
        turn_rate: Rate at which a person turns or starts, 1/s.
        stop_rate: Rate at which a person stops, 1/s.
        leave_rate: Rate at which tracked people leave for good, 1/s.
        lose_rate: Rate at which a hidden person may get anywhere, 1/s. Raising it finds a lost person sooner by color
            alone, and confuses people of similar color sooner.
        merge_distance: Distance below which two people share a detection, widths.
        cover_margin: Width of an umbrella's rim under which a person is still detected, widths.
        color_outlier: Probability that a color says nothing.
        clutter_rate: Weight of a new frame in the expected number of unexplained detections.
        image_width: Width of the square image in whose pixels all lengths are given, px.
        first_color: Standard deviation of the color in the first picture, gray levels.
        first_people: Expected number of people in the first frame.
        tracks: Largest number of tracks.
        hypotheses: Largest number of hypotheses of the person. Computing time grows in proportion.

    Raises:
        ValueError: An argument is not positive and finite, or a probability is not below 1.
    """

    acceleration: float = 0.8
    crowd_acceleration: float = 1.5
    speed: float = 1.6
    position_noise: float = 4.0
    color_noise: float = 9.0
    color_drift: float = 0.5
    size_noise: float = 0.14
    detection: float = 0.82
    births: float = 0.2
    hide_rate: float = 0.1
    show_rate: float = 0.8
    uncover_rate: float = 0.2
    turn_rate: float = 0.3
    stop_rate: float = 0.1
    leave_rate: float = 0.02
    lose_rate: float = 0.03
    merge_distance: float = 0.8
    cover_margin: float = 0.24
    color_outlier: float = 0.02
    clutter_rate: float = 0.02
    image_width: float = 480.0
    first_color: float = 30.0
    first_people: float = 5.0
    tracks: int = 32
    hypotheses: int = 40

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < np.inf:
                raise ValueError(f"{field.name} must be finite and > 0, got {value!r}")
        for name in ("detection", "color_outlier", "clutter_rate"):
            if not getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie in (0, 1), got {getattr(self, name)!r}")

    @cached_property
    def _rules(self) -> CrowdRules:
        return CrowdRules(*(float(getattr(self, name)) for name in CrowdRules._fields))

    def initial(self, detections: Array, place: Array, width: Array, color: Array) -> CrowdState:
        """State before the update with the first frame.

        Args:
            detections: Detections of that frame. Shape (B, M, 8).
            place: Middle of the person in that frame. Shape (B, 2), px.
            width: Width of the person in that frame. Shape (B,), px.
            color: Color of the person. Shape (B, 3), gray levels.

        Raises:
            ValueError: As `PersonFollower.initial`.
        """
        runs = len(checked(detections))
        place = checked_rows("place", place, (runs, 2), LIMITS.pixels)
        width = checked_rows("width", width, (runs,), LIMITS.pixels)
        color = checked_rows("color", color, (runs, 3), LIMITS.pixels)
        if not (width > 0.0).all():
            raise ValueError(f"width must be > 0 px, got {width.min():g}; pass the width of the person's box")
        crowd, guesses = self._nobody(runs, self.tracks), self._nobody(runs, self.hypotheses)
        for people in (crowd, guesses):
            people.mean[:, 0, :2] = place
            people.spread[:, 0, 0] = self.position_noise**2
            people.spread[:, 0, 2] = (self.speed * width) ** 2
            people.color[:, 0], people.color_variance[:, 0] = color, self.first_color**2
            people.width[:, 0], people.weight[:, 0], people.label[:, 0] = width, 0.999, 0
        memory = CrowdMemory(
            width=np.array(width, np.float64),
            color=np.array(color, np.float64),
            color_variance=np.full(runs, self.first_color**2),
            lost=np.full(runs, 1e-6),
            clutter=np.ones(runs),
            next_label=np.ones(runs, np.int64),
            place=np.array(place, np.float64),
            motion=np.zeros((runs, 2)),
            unseen=np.zeros(runs, np.int64),
            confidence=np.ones(runs),
        )
        return CrowdState(crowd, guesses, memory)

    def _nobody(self, runs: int, count: int) -> People:
        return People(
            np.zeros((runs, count, 4)),
            np.zeros((runs, count, 3)),
            np.zeros((runs, count, 3)),
            np.ones((runs, count)),
            np.ones((runs, count)),
            np.zeros((runs, count)),
            np.zeros((runs, count)),
            np.full((runs, count), -1),
        )

    def step(
        self,
        state: CrowdState,
        detections: Array,
        fresh: Mask,
        elapsed: Array,
        ego_motion: EgoMotion,
        joints_before: Array,
        joints_after: Array,
        ego_variance: Array,
    ) -> tuple[CrowdState, Sighting]:
        """Update with one frame, in the runs that have a new one.

        Args:
            state: Result of `initial` or of the last `step`.
            detections: Detections of the frame. Shape (B, M, 8).
            fresh: Mask of the runs with a new frame. Shape (B,), bool.
            elapsed: Time since the last frame. Shape (B,), s.
            ego_motion: Predicted motion of points at rest in the image.
            joints_before: Joint angles at the last frame. Shape (B, n), rad.
            joints_after: Joint angles at this frame. Shape (B, n), rad.
            ego_variance: Variance of that motion along each axis. Shape (B,), px^2. Raising it trusts the crowd
                more, and the arm less, about the image's motion.

        Returns:
            The new state, and the image position of the person.

        Raises:
            ValueError: As `PersonFollower.step`.
        """
        detections = np.ascontiguousarray(checked(detections))
        runs = state.place.shape[:1]
        if detections.shape[:1] != runs:
            raise ValueError(
                f"detections must be of the state's {runs[0]} runs, got {len(detections)}; call initial for a new state"
            )
        fresh = as_mask("fresh", fresh)
        if fresh.shape != runs:
            raise ValueError(f"fresh must have shape {runs}, got {fresh.shape}; pass one truth value per run")
        elapsed = checked_rows("elapsed", elapsed, runs, LIMITS.times)
        ego_variance = checked_rows("ego_variance", ego_variance, runs, np.inf)
        new = copied(state)
        _carry(new, fresh, ego_motion, joints_before, joints_after)
        features, visible = np.zeros(new.place.shape), np.zeros(len(fresh), np.bool_)
        follow_crowd(
            detections, fresh, np.maximum(elapsed, 1e-3), ego_variance, new.crowd, new.guesses, new.memory,
            self._rules, features, visible,
        )  # fmt: skip
        return new, Sighting(features, visible)


def _carry(state: CrowdState, fresh: Mask, ego_motion: EgoMotion, joints_before: Array, joints_after: Array) -> None:
    """Move positions and velocities of all people with the camera, in the runs with a new frame."""
    tables = (state.crowd.mean, state.guesses.mean)
    memory = np.concatenate([state.memory.place, state.memory.motion], axis=-1)[:, None]
    mean = np.concatenate([*tables, memory], axis=1)
    step = 0.05
    here = ego_motion(mean[..., :2], joints_before, joints_after)
    ahead = ego_motion(mean[..., :2] + step * mean[..., 2:], joints_before, joints_after)
    moved = np.concatenate([here, (ahead - here) / step], axis=-1)
    moved = np.where(fresh[:, None, None], moved, mean)
    first = 0
    for table in tables:
        table[:] = moved[:, first : first + table.shape[1]]
        first += table.shape[1]
    state.memory.place[:], state.memory.motion[:] = moved[:, -1, :2], moved[:, -1, 2:]
