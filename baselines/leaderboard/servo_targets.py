"""Knowledge of a servo's target that has the law of its motion: slopes by unknown numbers, turns and their chances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servotrack.envs.servo.layout import drawn_waves, never_rejected, ranges_of
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.records import CONSTANTS
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_MARGIN, PERIOD, RATE_FRACTION, SINGULAR_SINE
from servotrack.estimators.types import Array, Labels, Mask

SPREAD = 1.0 / (2.0 * math.pi)
"""Standard deviation of a Gaussian with the Fisher information of a squared cosine over a range of width 1."""
_CENTER_WIDTH = 0.2
_ELLIPSE_WIDTHS = ((0.2, 1.0),)
_TWO_SINE_WIDTHS = ((0.12, 0.6), (0.07, 1.0))
"""Widths of the ranges of amplitude, as a fraction of the reach, and angular rate, rad/s, of each wave."""
_REACHED_WIDTH = 1.0
"""Width of the places that the arm reaches, as a fraction of the reach."""
_SPEED_WIDTH = 0.7
"""Width of the velocities of a waypoint target along each axis, as a fraction of the reach per s."""
_FAIREST_TURN = 1.3
"""Largest angle of joint 1 at a waypoint, rad."""
_WAYPOINT_ELBOW = (0.4, 2.4)
"""Range of joint 2 at a waypoint, rad."""
_SAME_VELOCITY = 1e-9
"""Velocities closer than this are those of one run, m/s."""
_STEP = 0.002
"""Step along a run in which the chance of its end is summed, m."""


def wave_slopes(config: ServoConfig, seed: int, times: Array, reach: float) -> tuple[Array, Array]:
    """Slopes of a target's positions by the numbers that its law leaves open.

    Args:
        config: Parameters of the world, with a target that moves along waves or rests.
        seed: Seed of the episode.
        times: Sample times, shape (K,), s.
        reach: Sum of the link lengths, m.

    Returns:
        Slopes, shape (K, 2, n), and the standard deviation of each number before the first frame, shape (n,).
    """
    if config.target in ("paper", "paper_point"):
        return np.zeros((len(times), 2, 0)), np.zeros(0)
    columns, widths = [], []

    def add(width: float, *along: Array | float) -> None:
        """Add a number with its range and the slopes along x and y."""
        columns.append(np.stack([np.broadcast_to(slope, len(times)) for slope in along], axis=-1))
        widths.append(width)

    center = _REACHED_WIDTH if config.target == "point" else _CENTER_WIDTH
    add(center, reach, 0.0)
    add(center, 0.0, reach)
    if config.target != "point":
        constants, path = np.zeros(1, CONSTANTS), np.zeros((len(times), 4))
        _, waves = drawn_waves(seed, ranges_of(config), never_rejected(config), constants[0], path)
        clock = np.maximum(times, 0.0) if config.warmup > 0 else times
        amplitude, rate, phase = (waves[:, :, i, None] for i in range(3))
        angle = rate * clock + phase
        by_amplitude, by_phase = reach * np.cos(angle), -reach * amplitude * np.sin(angle)
        by_rate = by_phase * clock
        none = np.zeros(len(times))
        if config.target == "ellipse":
            # Both axes share rate and phase; the turn between them, to the left or right, is known.
            ((amplitude_width, rate_width),) = _ELLIPSE_WIDTHS
            add(amplitude_width, by_amplitude[0, 0], none)
            add(amplitude_width, none, by_amplitude[1, 0])
            add(rate_width, *by_rate[:, 0])
            add(2.0 * math.pi, *by_phase[:, 0])
        else:
            for wave, (amplitude_width, rate_width) in enumerate(_TWO_SINE_WIDTHS):
                for width, slope in (
                    (amplitude_width, by_amplitude), (rate_width, by_rate), (2.0 * math.pi, by_phase)
                ):  # fmt: skip
                    add(width, slope[0, wave], none)
                    add(width, none, slope[1, wave])
    return np.stack(columns, axis=-1), SPREAD * np.array(widths)


@dataclass(frozen=True)
class WaveKnowledge:
    """Knowledge of E targets along waves: numbers that stay, of which the position is a function.

    Attributes:
        slopes: Slopes of positions by the numbers. Shape (E, K, 2, n).
        prior: Covariance of the numbers before the first frame. Shape (E, n, n).
    """

    slopes: Array
    prior: Array

    def seen(self, frames: Labels) -> Array:
        """Slopes of the positions in frames (E,) by the state. Shape (E, 2, n)."""
        return self.slopes[np.arange(len(frames)), frames]

    def ahead(self, sample: int) -> Array:
        """Slopes of the positions at a later sample by the state. Shape (E, 2, n)."""
        return self.slopes[:, sample]

    def advance(self, covariance: Array, frames: Labels) -> Array:
        """Joint covariance (E, N, N), the state last, at the next frame."""
        return covariance


@dataclass(frozen=True)
class WaypointKnowledge:
    """Knowledge of E waypoint targets: position and velocity at the newest frame, and turns up to there.

    Attributes:
        age: Time from the newest frame to the end of the next period. Shape (E,), s.
        back: Time from the readout of the target's row to the end of its frame. Shape (E,), s.
        prior: Covariance of position and velocity before the first frame. Shape (E, 4, 4).
        fresh: Variance along each axis of the velocity after a turn. Shape (E,), m^2/s^2.
        turned: Mask of the periods with a turn, from sample k to k + 1. Shape (E, K - 1).
        since: Time from sample k to the turn. Shape (E, K - 1), s.
    """

    age: Array
    back: Array
    prior: Array
    fresh: Array
    turned: Mask
    since: Array

    def seen(self, frames: Labels) -> Array:
        """Slopes of the positions in frames (E,) by the state. Shape (E, 2, 4)."""
        return _moved(-self.back)

    def ahead(self, sample: int) -> Array:
        """Slopes of the positions at the end of the next period by the state. Shape (E, 2, 4)."""
        return _moved(self.age)

    def advance(self, covariance: Array, frames: Labels) -> Array:
        """Joint covariance (E, N, N), the state last, one sample after frames (E,)."""
        rows, size = np.arange(len(frames)), covariance.shape[1]
        turned, since = self.turned[rows, frames], self.since[rows, frames]
        with_old = np.where(turned, since, PERIOD)
        transition, noise = np.tile(np.eye(size), (len(rows), 1, 1)), np.zeros_like(covariance)
        new = np.stack([PERIOD - with_old, np.ones(len(rows))], axis=-1)
        for axis in range(2):
            place, velocity = size - 4 + axis, size - 2 + axis
            transition[:, place, velocity] = with_old
            transition[turned, velocity, velocity] = 0.0
            both = np.ix_(rows, (place, velocity), (place, velocity))
            noise[both] = (turned * self.fresh)[:, None, None] * new[:, :, None] * new[:, None, :]
        return transition @ covariance @ transition.transpose(0, 2, 1) + noise


TargetKnowledge = WaveKnowledge | WaypointKnowledge


def wave_knowledge(config: ServoConfig, seeds: Sequence[int], times: Array, links: Array) -> WaveKnowledge:
    """Knowledge of the targets of episodes (E seeds, links (E, 2) m) at sample times (K,) s before the first frame."""
    found = [wave_slopes(config, seed, times, float(pair.sum())) for seed, pair in zip(seeds, links, strict=True)]
    slopes, spreads = (np.stack(part) for part in zip(*found, strict=True))
    return WaveKnowledge(slopes, spreads[:, :, None] ** 2 * np.eye(spreads.shape[1]))


def waypoint_knowledge(paths: Array, links: Array, age: Array, back: Array) -> WaypointKnowledge:
    """Knowledge of waypoint targets before the first frame.

    Args:
        paths: Positions and velocities, shape (E, K, 4), m and m/s.
        links: Link lengths, shape (E, 2), m.
        age: See `WaypointKnowledge`.
        back: See `WaypointKnowledge`.
    """
    before, after = paths[:, :-1], paths[:, 1:]
    change = before[..., 2:] - after[..., 2:]
    square = (change**2).sum(axis=-1)
    turned = square > _SAME_VELOCITY**2
    # Both runs meet at the turn: p + v s = p' - v' (T - s).
    gap = after[..., :2] - before[..., :2] - PERIOD * after[..., 2:]
    since = np.clip((change * gap).sum(axis=-1) / np.where(turned, square, 1.0), 0.0, PERIOD)
    place, fresh = ((SPREAD * width * links.sum(axis=1)) ** 2 for width in (_REACHED_WIDTH, _SPEED_WIDTH))
    prior = np.stack([place, place, fresh, fresh], axis=-1)[:, :, None] * np.eye(4)
    return WaypointKnowledge(age, back, prior, fresh, turned, since)


def _moved(duration: Array) -> Array:
    """Slopes of the position after a duration (E,) s by position and velocity. Shape (E, 2, 4)."""
    return np.concatenate([np.tile(np.eye(2), (len(duration), 1, 1)), duration[:, None, None] * np.eye(2)], axis=-1)


def turn_chances(config: ServoConfig, paths: Array, links: Array, knowledge: WaypointKnowledge) -> Array:
    """Chance that a target turns within the time that the controller cannot see, given that it has not turned before.

    Args:
        config: Parameters of the world.
        paths: Positions and velocities, shape (E, K, 4), m and m/s.
        links: Link lengths, shape (E, 2), m.
        knowledge: Turns of the targets.

    Returns:
        For a newest frame at each sample, shape (E, K).
    """
    chance = np.zeros(paths.shape[:2])
    for row in range(len(paths)):
        starts = [0, *(np.flatnonzero(knowledge.turned[row]) + 1), paths.shape[1]]
        for first, last in pairwise(starts):
            age = float(knowledge.age[row])
            chance[row, first:last] = _run_chances(config, paths[row, first:last], links[row], age)
    return chance


def _run_chances(config: ServoConfig, run: Array, links: Array, blind: float) -> Array:
    """Chance that a run ends within `blind` (s) of each of its samples (k, 4), given that it has not ended before.

    The end is drawn uniformly in joint space, so that its density along the run is that of the place times the distance
    from the start; the run must be one that the arm can follow.
    """
    velocity = run[0, 2:]
    speed = float(np.hypot(*velocity))
    if speed == 0.0:
        return np.zeros(len(run))
    (l1, l2), along = links, velocity / speed
    distance = np.arange(0.0, 2.0 * (l1 + l2), _STEP)
    places = run[0, :2] + distance[:, None] * along
    radius = np.hypot(*places.T)
    cosine = (radius**2 - l1 * l1 - l2 * l2) / (2.0 * l1 * l2)
    theta2 = np.arccos(np.clip(cosine, -1.0, 1.0))
    theta1 = np.arctan2(places[:, 1], places[:, 0]) - np.arctan2(l2 * np.sin(theta2), l1 + l2 * cosine)
    followed = (np.abs(cosine) < 1.0) & (np.abs(theta1) < JOINT_HIGH[0] - JOINT_MARGIN)
    followed &= np.abs(theta2 - 0.5 * JOINT_HIGH[1]) < 0.5 * JOINT_HIGH[1] - JOINT_MARGIN
    followed &= l2 * np.sin(theta2) >= SINGULAR_SINE * radius
    fastest = np.maximum(np.abs(np.gradient(theta1)), np.abs(np.gradient(theta2))) * speed / _STEP
    followed &= fastest < RATE_FRACTION * config.max_joint_rate
    # The run ends before the first place that the arm cannot follow to.
    followed = np.logical_and.accumulate(followed | (distance == 0.0))
    fair = (np.abs(theta1) < _FAIREST_TURN) & (theta2 > _WAYPOINT_ELBOW[0]) & (theta2 < _WAYPOINT_ELBOW[1])
    density = np.where(followed & fair, distance / np.maximum(np.sin(theta2), 1e-9), 0.0)
    total = np.concatenate([[0.0], np.cumsum(density)])
    gone = np.arange(len(run)) * PERIOD * speed / _STEP
    ended, soon = (np.interp(x, np.arange(len(total)), total) for x in (gone, gone + blind * speed / _STEP))
    left = total[-1] - ended
    return np.where(left > 0.0, (soon - ended) / np.where(left > 0.0, left, 1.0), 1.0)
