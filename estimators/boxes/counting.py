"""Numbers of people with intervals: in the frame, in a zone, and across a line.

Every box has a probability that it is a person, and boxes count as independent, so their number has a Poisson-binomial
distribution. People that the detector never finds add to the number: in a frame or a zone their number is Poisson, in
proportion to those who were found. Over the whole of a sequence the share itself matters: of the crossings of a line
that are missed only the mean share is known, the distribution of largest entropy of that share is exponential, and
their number is therefore geometric. A count without an interval hides all this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Array, Labels, Mask
from servotrack.estimators.validation import LIMITS, as_numbers, check_within, checked_period

NEGLIGIBLE = 1e-12
"""Probability of a number below which the number is left out of a distribution."""

UNDETECTED = 0.3
"""Expected number of undetected people for each one with a track, as on the sequences of docs/counting.md."""


class Count(NamedTuple):
    """A number of people.

    Attributes:
        expected: Expected number.
        low, high: Ends of the interval, both included.
    """

    expected: float
    low: int
    high: int


@dataclass(frozen=True, eq=False)
class NumberDistribution:
    """Distribution of a number.

    Attributes:
        first: Smallest possible number.
        probability: Probabilities of first, first + 1, ... Shape (k,).
    """

    first: int
    probability: Array

    @property
    def expected(self) -> float:
        """Expected number."""
        return float((self.first + np.arange(len(self.probability))) @ self.probability)

    def interval(self, level: float = 0.9) -> Count:
        """Expected number and central interval.

        Args:
            level: Smallest probability of the interval, in (0, 1). Raising it widens the interval.

        Raises:
            ValueError: `level` is out of range.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level must be in (0, 1), got {level!r}")
        below = np.cumsum(self.probability)
        tail = (1.0 - level) / 2.0
        numbers = self.first + np.arange(len(below))
        last = len(below) - 1
        low, high = (min(int(np.searchsorted(below, share)), last) for share in (tail, 1.0 - tail - NEGLIGIBLE))
        return Count(self.expected, int(numbers[low]), int(numbers[high]))


NOBODY = NumberDistribution(0, np.ones(1))
"""Distribution of a number that is 0."""


def add_chances(number: NumberDistribution, chances: ArrayLike) -> NumberDistribution:
    """Add independent events to a number.

    Args:
        number: Distribution of the number so far.
        chances: Probability of each event. Shape (k,).

    Raises:
        ValueError: A probability is not in [0, 1].
    """
    p = as_numbers("chances", chances).reshape(-1)
    if not len(p):
        return number
    _check_chances("chances", p)
    return _trimmed(number.first, _convolved(np.ascontiguousarray(number.probability), p))


def add_missed(number: NumberDistribution, missed: float) -> NumberDistribution:
    """Add the events that were not seen, whose number is geometric with a mean in proportion to the seen ones.

    Args:
        number: Distribution of the number of seen ones.
        missed: Expected number of missed ones for each seen one, at least 0.
    """
    mean = missed * number.expected
    if mean <= 0.0:
        return number
    share = mean / (1.0 + mean)
    others = np.arange(int(np.log(NEGLIGIBLE) / np.log(share)) + 1)
    return _trimmed(number.first, np.convolve(number.probability, (1.0 - share) * share**others))


def people_count(
    estimate: SetEstimate,
    undetected: float = UNDETECTED,
    level: float = 0.9,
    frame_size: tuple[int, int] | None = None,
) -> Count:
    """Number of people in the frame: reported ones, held ones, and those without a track.

    Args:
        estimate: Estimate of a frame.
        undetected: Expected number of people without a track for each one with a track, at least 0. Raising it raises
            the number and widens the interval; 0 counts only people that the detector finds.
        level: Probability of the interval, in (0, 1).
        frame_size: Width and height of the frame, px: held people are counted if the middle of their box is inside.
            A moving camera leaves others behind. None counts all.

    Raises:
        ValueError: An argument is out of range, or the estimate holds boxes or probabilities that cannot be.
    """
    _check_share("undetected", undetected)
    _check_estimate(estimate)
    held = estimate.held_existence
    if frame_size is not None:
        middle = estimate.held_states[:, :2] + estimate.held_states[:, 2:] / 2.0
        held = held[((middle >= 0.0) & (middle <= np.asarray(frame_size))).all(axis=1)]
    chances = np.concatenate([estimate.existence, held])
    return _with_undetected(chances, undetected).interval(level)


@dataclass(frozen=True)
class ZoneCount:
    """Number of people whose feet, the middle of the box's lower edge, are in a polygon.

    Args:
        corners: Corners of the polygon, at least three, px. The last one is joined to the first.
        level: Probability of the interval, in (0, 1).
        undetected: Expected number of people without a track for each one with a track, at least 0, as in
            `people_count`.

    Raises:
        ValueError: Fewer than three corners, corners on one line, numbers that are not finite or beyond a million, or
            a share that is not in 0 to 100.
    """

    corners: Sequence[tuple[float, float]]
    level: float = 0.9
    undetected: float = UNDETECTED

    def __post_init__(self) -> None:
        corners = _checked_points("corners", self.corners, 3)
        if np.linalg.matrix_rank(corners - corners[0]) < 2:
            raise ValueError(f"corners must enclose an area, got points on one line: {self.corners!r}")
        _check_share("undetected", self.undetected)

    def count(self, estimate: SetEstimate) -> Count:
        """Number of people in the zone in a frame: reported ones, held ones, and those without a track.

        Raises:
            ValueError: The estimate holds boxes or probabilities that cannot be.
        """
        _check_estimate(estimate)
        states = np.concatenate([estimate.states, estimate.held_states])
        chances = np.concatenate([estimate.existence, estimate.held_existence])
        inside = _inside(_feet(states), np.asarray(self.corners, dtype=np.float64))
        return _with_undetected(chances[inside], self.undetected).interval(self.level)


class Crossings(NamedTuple):
    """People who crossed a line so far.

    Attributes:
        forward: From the left to the right side of the line, seen from its first point to its second one in the image.
        backward: From the right to the left side.
    """

    forward: Count
    backward: Count


class LineState(NamedTuple):
    """State of a `LineCount`.

    Attributes:
        labels: Identities reported before. Shape (k,).
        feet: Last reported feet of each that were clear of the line, or the first ones. Shape (k, 2), px.
        absent: Time since the last report, s. Shape (k,).
        forward, backward: Distributions of the numbers of crossings seen so far.
        crossings: Numbers of all crossings so far, from these distributions.
    """

    labels: Labels
    feet: Array
    absent: Array
    forward: NumberDistribution
    backward: NumberDistribution
    crossings: Crossings


@dataclass(frozen=True)
class LineCount:
    """Numbers of people whose feet crossed a line segment, in both directions.

    Args:
        start: First point of the segment, px.
        end: Second point, px.
        level: Probability of the intervals, in (0, 1).
        margin: Distance from the line from which a person is clear of it, in heights of the person's box. Who crosses
            counts once clear on the other side. Raising it counts fewer people who walk along the line, whose feet
            the tracker puts now on one side and now on the other; it loses those who turn back soon.
        missed: Expected number of crossings that are not seen for each one that is, at least 0; the default is that
            of the MOTChallenge sequences of docs/counting.md. Raising it raises the number and widens the interval; 0
            counts only crossings that the tracker sees.
        memory: Time for which an unreported person is remembered, s. Raising it counts people who cross while they are
            hidden, as long as the tracker keeps their identity.
        frame_rate: Frames per second, where `step` is not given the time between frames.

    Raises:
        ValueError: Points that are equal, not finite or beyond a million, a share that is not in 0 to 100, a negative
            margin or memory, or a frame rate that is not positive.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    level: float = 0.9
    margin: float = 0.1
    missed: float = 0.4
    memory: float = 40.0
    frame_rate: float = 25.0

    def __post_init__(self) -> None:
        _checked_points("start and end", [self.start, self.end], 2)
        if tuple(self.start) == tuple(self.end):
            raise ValueError(f"start and end must be different points, got {self.start!r} twice")
        if not (self.margin >= 0.0 and np.isfinite(self.margin)):
            raise ValueError(f"margin must be at least 0, got {self.margin!r}")
        _check_share("missed", self.missed)
        if not self.memory >= 0:
            raise ValueError(f"memory must be at least 0 s, got {self.memory!r}")
        if not (self.frame_rate > 0.0 and np.isfinite(self.frame_rate)):
            raise ValueError(f"frame_rate must be finite and > 0, got {self.frame_rate!r}")

    def initial(self) -> LineState:
        """State before the first frame."""
        none = np.zeros(0, np.int64)
        nobody = self._count(NOBODY)
        return LineState(none, np.zeros((0, 2)), np.zeros(0), NOBODY, NOBODY, Crossings(nobody, nobody))

    def step(self, state: LineState, estimate: SetEstimate, dt: float | None = None) -> tuple[LineState, Crossings]:
        """Count the crossings between the last reports and this frame.

        Args:
            state: State after the last frame.
            estimate: Estimate of this frame; only reported people cross.
            dt: Time since the last frame, s; None for 1 / `frame_rate`.

        Raises:
            ValueError: `dt` is not positive, or the estimate holds boxes or probabilities that cannot be.
        """
        _check_estimate(estimate)
        dt = checked_period(dt, self.frame_rate)
        feet = _feet(estimate.states)
        before = np.full(len(feet), -1)
        order = np.argsort(state.labels)
        if len(order) and len(feet):
            at = np.minimum(np.searchsorted(state.labels[order], estimate.labels), len(order) - 1)
            known = state.labels[order][at] == estimate.labels
            before[known] = order[at[known]]
        old = before >= 0
        margins = self.margin * estimate.states[:, 3]
        ends = np.array([self.start, self.end], dtype=np.float64)
        side, clear = _crossed(ends, state.feet, before, feet, margins)
        forward = add_chances(state.forward, estimate.existence[side > 0.0])
        backward = add_chances(state.backward, estimate.existence[side < 0.0])
        waiting = old & ~clear
        feet[waiting] = state.feet[before[waiting]]
        gone = np.ones(len(state.labels), np.bool_)
        gone[before[old]] = False
        absent = state.absent + dt
        gone &= absent <= self.memory + 0.5 * dt
        after = LineState(
            np.concatenate([estimate.labels, state.labels[gone]]),
            np.concatenate([feet, state.feet[gone]]),
            np.concatenate([np.zeros(len(feet)), absent[gone]]),
            forward,
            backward,
            # Most frames see no crossing.
            Crossings(
                state.crossings.forward if forward is state.forward else self._count(forward),
                state.crossings.backward if backward is state.backward else self._count(backward),
            ),
        )
        return after, after.crossings

    def _count(self, number: NumberDistribution) -> Count:
        """Number of crossings, seen and missed."""
        return add_missed(number, self.missed).interval(self.level)


def _feet(boxes: Array) -> Array:
    """Middle of the lower edge. Shape (k, 2), px."""
    return np.column_stack([boxes[:, 0] + boxes[:, 2] / 2.0, boxes[:, 1] + boxes[:, 3]])


def _inside(points: Array, corners: Array) -> Mask:
    """Mask of the points in a polygon, by the number of edges that a ray to the right meets."""
    x, y = points[:, 0, None], points[:, 1, None]
    a, b = corners, np.roll(corners, -1, axis=0)
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    meets = spans & (x < a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise)
    return np.asarray(meets.sum(axis=1) % 2 == 1)


def _with_undetected(chances: Array, undetected: float) -> NumberDistribution:
    """Number of people with these probabilities and of the undetected ones beside them."""
    number = add_chances(NOBODY, chances)
    rate = undetected * float(chances.sum())
    if rate <= 0.0:
        return number
    others = np.arange(int(rate + 10.0 * np.sqrt(rate)) + 20)
    poisson = np.exp(others * np.log(rate) - rate - gammaln(others + 1.0))
    return _trimmed(number.first, np.convolve(number.probability, poisson))


def _trimmed(first: int, probability: Array) -> NumberDistribution:
    """Distribution without the numbers at its ends that are next to impossible."""
    likely = np.flatnonzero(probability > NEGLIGIBLE)
    kept = probability[likely[0] : likely[-1] + 1]
    return NumberDistribution(first + int(likely[0]), kept / kept.sum())


def _check_chances(name: str, chances: Array) -> None:
    good = (chances >= 0.0) & (chances <= 1.0)
    if not good.all():
        raise ValueError(f"{name} must be in [0, 1], got {chances[~good].flat[0]}")


def _check_estimate(estimate: SetEstimate) -> None:
    """Check an estimate, since one of another source may hold boxes that would count nowhere."""
    for name, states, existence in (
        ("estimate.states", estimate.states, estimate.existence),
        ("estimate.held_states", estimate.held_states, estimate.held_existence),
    ):
        if states.ndim != 2 or states.shape[1] != 4 or existence.shape != states.shape[:1]:
            raise ValueError(
                f"{name} must be boxes (left, top, width, height) with one probability each, got shapes {states.shape} "
                f"and {existence.shape}"
            )
        check_within(name, states, LIMITS.boxes, "leave out boxes that are not known")
        _check_chances(name.replace("states", "existence"), existence)


def _check_share(name: str, share: float) -> None:
    if not 0.0 <= share <= 100.0:
        raise ValueError(f"{name} must be in 0 to 100, got {share!r}; 1 is as many as the detector finds")


def _checked_points(name: str, points: Sequence[tuple[float, float]], least: int) -> Array:
    array = as_numbers(name, points)
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < least or not np.isfinite(array).all():
        raise ValueError(f"{name} must be at least {least} points (x, y) with finite numbers, got {points!r}")
    check_within(name, array, LIMITS.boxes, "give px of the frame")
    return array


@njit(cache=True, nogil=True)
def _convolved(probability, chances):  # type: ignore[no-untyped-def]
    """Poisson-binomial recursion. Shape (k + number of chances,)."""
    out = np.zeros(len(probability) + len(chances))
    out[: len(probability)] = probability
    size = len(probability)
    for chance in chances:
        for k in range(size, 0, -1):
            out[k] = out[k] * (1.0 - chance) + out[k - 1] * chance
        out[0] *= 1.0 - chance
        size += 1
    return out


@njit(cache=True, nogil=True)
def _crossed(ends, points, before, feet, margins):  # type: ignore[no-untyped-def]
    """Crossings of a line segment.

    Args:
        ends: Ends of the segment. Shape (2, 2), px.
        points: Feet of known people when they were last clear of the line. Shape (n, 2).
        before: Index of each person in `points`; -1: not known. Shape (k,).
        feet: Feet now. Shape (k, 2).
        margins: Distance from which each person is clear of the line, px. Shape (k,).

    Returns:
        1, -1 or 0 for each person: crossed forward, backward, or not; and a mask of those who are clear of the line.
    """
    crossed, clear = np.zeros(len(feet)), np.zeros(len(feet), np.bool_)
    (x0, y0), (x1, y1) = ends[0], ends[1]
    length = np.hypot(x1 - x0, y1 - y0)
    for k in range(len(feet)):
        x, y = feet[k]
        side = _side(x0, y0, x1, y1, x, y)
        clear[k] = np.abs(side) / length >= margins[k]
        if before[k] < 0 or not clear[k]:
            continue
        a, b = points[before[k]]
        # A point on the line counts as on its right side, so that nobody crosses twice by stopping there.
        right, was_right = side >= 0.0, _side(x0, y0, x1, y1, a, b) >= 0.0
        within = (_side(a, b, x, y, x0, y0) >= 0.0) != (_side(a, b, x, y, x1, y1) >= 0.0)
        if within and right != was_right:
            crossed[k] = 1.0 if right else -1.0
    return crossed, clear


@njit(cache=True, nogil=True)
def _side(x0, y0, x1, y1, x, y):  # type: ignore[no-untyped-def]
    """Positive for a point (x, y) to the right of a line in the image, whose rows grow downward."""
    return (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
