"""A whole episode's people in the image, frame by frame, each in a row of their own while they are there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from servotrack.envs.track.pedestrians.people import People
from servotrack.estimators.types import Array, Labels

_MARGIN = 0.7
"""How far outside the image somebody is still drawn, body heights; shadows fall into it."""


class ImagePath(NamedTuple):
    """One person's life in the image, k frames.

    Attributes:
        first: First frame.
        feet: Shape (k, 2), px.
        height: Shape (k,), px.
        heading: Shape (k,), rad.
        phase: Shape (k,), rad.
        stride: Shape (k,).
        outfit_seed: Seed of how they look.
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
    """Everybody's movement; K frames, n rows, of which one belongs to a person for life and then to another.

    Attributes:
        ids: Who is in a row, from 1; 0 for nobody. Shape (K, n), int.
        feet: Shape (K, n, 2), px.
        height: Shape (K, n), px.
        heading: Shape (K, n), rad.
        phase: Shape (K, n), rad.
        stride: Shape (K, n).
        outfit_seeds: Shape (K, n), int.
        width: Of the image, px.
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
        """Who may be seen in a frame, and their rows."""
        ids, feet, height = self.ids[frame], self.feet[frame], self.height[frame]
        column, reach = feet[:, 0], _MARGIN * height
        rows = np.flatnonzero((ids > 0) & (column > -reach) & (column < self.width + reach))
        # A view of the frame and then its rows: several times cheaper than both in one index.
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
    """Give everybody a row.

    Args:
        paths: In the order of their first frames; what lies outside the frames is left out.
        frames: Number of frames K.
        rows: Number of rows n.
        width: Of the image, px.
        shown_from: First frame that shows anybody.

    Raises:
        ValueError: More people at a time than rows.
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
        # The row that has been free for longest, so that nobody is taken for who left it just before.
        row = int(np.argmin(free_from))
        if free_from[row] > start:
            there = int((free_from > start).sum()) + 1
            raise ValueError(f"max_people must be at least {there}: so many are there in frame {start}, got {rows}")
        identity += 1
        free_from[row] = stop
        at, of = slice(start, stop), slice(start - path.first, stop - path.first)
        made.ids[at, row], made.outfit_seeds[at, row] = identity, path.outfit_seed
        made.feet[at, row], made.height[at, row] = path.feet[of], path.height[of]
        made.heading[at, row] = path.heading[of]
        made.phase[at, row], made.stride[at, row] = path.phase[of], path.stride[of]
    return made


_SMOOTHING = 0.16
"""Time over which a gait follows the speed, s."""
_TURNING = 0.2
"""Time over which a body follows its direction, s."""
_WALKS_FROM = 0.1
"""Speed from which somebody faces where they go, body heights per second."""


@njit(cache=True, nogil=True)
def gait(steps, facing, first_heading, first_phase, dt):  # type: ignore[no-untyped-def]
    """Heading, phase and stride along a path.

    A stride grows with speed, as people's do: 0.4 heights standing, 0.84 at one height per second.

    Args:
        steps: Way from frame to frame on the floor, body heights; the first from the frame before. Shape (k, 2).
        facing: Where to face while standing, NaN for as before, shape (k,), rad.
        first_heading: Heading before the first frame, rad; NaN for that of the first steps.
        first_phase: Phase before the first frame, rad.
        dt: Between frames, s.

    Returns:
        Shape (k, 3).
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
        if math.sqrt(vx * vx + vz * vz) > _WALKS_FROM:
            goal = math.atan2(vz, vx)
        elif not math.isnan(facing[k]):
            goal = facing[k]
        heading += turn * ((goal - heading + math.pi) % (2.0 * math.pi) - math.pi)
        heading = (heading + math.pi) % (2.0 * math.pi) - math.pi
        phase = (phase + 2.0 * math.pi * length / (0.4 + 0.44 * min(speed, 1.2))) % (2.0 * math.pi)
        out[k, 0], out[k, 1] = heading, phase
        out[k, 2] = min(1.0, (speed / 0.75) ** 0.7)
    return out
