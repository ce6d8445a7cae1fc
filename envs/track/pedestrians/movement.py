"""Movement of all people of an episode in the image, and the gait that follows from their steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.pedestrians.people import People
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels

_MARGIN = 0.7
"""Distance outside the image up to which people are drawn, body heights; their shadows can fall into it."""


class ImagePath(NamedTuple):
    """Path of one person in the image over k frames; quantities as in `People`.

    Attributes:
        first: First frame.
        feet: Positions of the feet, shape (k, 2), px.
        height: Heights, shape (k,), px.
        heading: Headings, shape (k,), rad.
        phase: Phases of the gait, shape (k,), rad.
        stride: Strides, shape (k,).
        outfit_seed: Seed of the outfit.
    """

    first: int
    feet: Array
    height: Array
    heading: Array
    phase: Array
    stride: Array
    outfit_seed: int


@dataclass(frozen=True)
class Movement:
    """Movement of all people over K frames in n rows; quantities as in `People`.

    A person keeps one row; after the person has left, a later one may get the row.

    Attributes:
        ids: Identity in each row, from 1; 0 for an unused row, shape (K, n), int.
        feet: Positions of the feet, shape (K, n, 2), px.
        height: Heights, shape (K, n), px.
        heading: Headings, shape (K, n), rad.
        phase: Phases of the gait, shape (K, n), rad.
        stride: Strides, shape (K, n).
        outfit_seeds: Seeds of the outfits, shape (K, n), int.
        width: Width of the image, px.
    """

    ids: Labels
    feet: Array
    height: Array
    heading: Array
    phase: Array
    stride: Array
    outfit_seeds: Labels
    width: float

    def people(self, frame: int) -> tuple[People, NDArray[np.intp]]:
        """Return the people who may be visible in a frame, and their rows."""
        ids, feet, height = self.ids[frame], self.feet[frame], self.height[frame]
        column, reach = feet[:, 0], _MARGIN * height
        rows = np.flatnonzero((ids > 0) & (column > -reach) & (column < self.width + reach))
        # A view of the frame, then its rows: several times faster than both in one index.
        people = People(
            ids[rows],
            feet[rows],
            height[rows],
            self.heading[frame][rows],
            self.phase[frame][rows],
            self.stride[frame][rows],
            self.outfit_seeds[frame][rows],
        )
        return people, rows


def assemble(paths: Sequence[ImagePath], frames: int, rows: int, width: float, shown_from: int = 0) -> Movement:
    """Assign a row to every path.

    Args:
        paths: Paths, ordered by their first frame. Parts outside the frames are left out.
        frames: Number of frames K.
        rows: Number of rows n.
        width: Width of the image, px.
        shown_from: First frame that shows people.

    Raises:
        ValueError: If there are more people at a time than rows.
    """
    made = Movement(
        np.zeros((frames, rows), np.int64), np.zeros((frames, rows, 2)), np.zeros((frames, rows)),
        np.zeros((frames, rows)), np.zeros((frames, rows)), np.zeros((frames, rows)),
        np.zeros((frames, rows), np.int64), width,
    )  # fmt: skip
    free_from = np.zeros(rows, np.int64)
    identity = 0
    for path in paths:
        start, stop = max(path.first, shown_from), min(path.first + len(path.height), frames)
        if stop <= start:
            continue
        # The row that has been free for longest, so that a new person is not confused with the previous one.
        row = int(np.argmin(free_from))
        if free_from[row] > start:
            there = int((free_from > start).sum()) + 1
            raise ValueError(f"max_people must be at least {there}, the number of people in frame {start}, got {rows}")
        identity += 1
        free_from[row] = stop
        at, of = slice(start, stop), slice(start - path.first, stop - path.first)
        made.ids[at, row], made.outfit_seeds[at, row] = identity, path.outfit_seed
        made.feet[at, row], made.height[at, row] = path.feet[of], path.height[of]
        made.heading[at, row] = path.heading[of]
        made.phase[at, row], made.stride[at, row] = path.phase[of], path.stride[of]
    return made


_SMOOTHING = 0.16
"""Time constant with which the gait follows the speed, s."""
_TURNING = 0.2
"""Time constant with which the heading follows the direction of motion, s."""
_MIN_WALKING_SPEED = 0.1
"""Minimum speed at which a person faces the direction of motion, body heights per second."""


@njit(cache=True, nogil=True)
def gait(steps, facing, first_heading, first_phase, dt):  # type: ignore[no-untyped-def]
    """Return heading, phase and stride along a path.

    The length of a stride grows with speed: 0.4 heights at rest, 0.84 at one height per second.

    Args:
        steps: Displacements on the floor from the previous frame, body heights, shape (k, 2).
        facing: Heading while standing, rad, shape (k,); NaN: unchanged.
        first_heading: Heading before the first frame, rad; NaN: that of the first steps.
        first_phase: Phase before the first frame, rad.
        dt: Time between frames, s.

    Returns:
        Heading (rad), phase (rad) and stride, shape (k, 3).
    """
    count = len(steps)
    out = np.empty((count, 3))
    if count == 0:
        return out
    ahead = min(count, 6)
    sx, sz = steps[:ahead, 0].sum(), steps[:ahead, 1].sum()
    speed = math.sqrt(sx * sx + sz * sz) / (ahead * dt)
    heading = first_heading
    if math.isnan(heading):
        heading = math.atan2(sz, sx)
    phase = first_phase
    vx, vz = sx / (ahead * dt), sz / (ahead * dt)
    follow, turn = dt / (dt + _SMOOTHING), dt / (dt + _TURNING)
    for k in range(count):
        dx, dz = steps[k, 0], steps[k, 1]
        length = math.sqrt(dx * dx + dz * dz)
        speed += follow * (length / dt - speed)
        vx += follow * (dx / dt - vx)
        vz += follow * (dz / dt - vz)
        goal = heading
        if math.sqrt(vx * vx + vz * vz) > _MIN_WALKING_SPEED:
            goal = math.atan2(vz, vx)
        elif not math.isnan(facing[k]):
            goal = facing[k]
        heading += turn * ((goal - heading + math.pi) % (2.0 * math.pi) - math.pi)
        heading = (heading + math.pi) % (2.0 * math.pi) - math.pi
        phase = (phase + 2.0 * math.pi * length / (0.4 + 0.44 * min(speed, 1.2))) % (2.0 * math.pi)
        out[k, 0], out[k, 1] = heading, phase
        out[k, 2] = min(1.0, (speed / 0.75) ** 0.7)
    return out
