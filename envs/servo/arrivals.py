"""Which frames have arrived since a sensor last looked, and what their stamps say."""

from __future__ import annotations

from operator import is_not

import numpy as np
from numba import njit

from servotrack.envs.servo.episode import LEAD, Episode
from servotrack.envs.servo.targets import PERIOD
from servotrack.envs.servo.world import ServoWorld


class Arrivals:
    """The newest frames of a world's N arms, as one sensor has taken note of them.

    Args:
        world: The world, which is only read.

    Attributes:
        rows: Whose frame is another than at the last look, (N,) bool.
        frame_time: Time stamps of the newest frames, (N,) s.
    """

    def __init__(self, world: ServoWorld) -> None:
        self._world = world
        self._episodes: list[Episode | None] = [None] * world.count
        self._captured = np.full(world.count, -1)
        self.rows, self.frame_time = np.zeros(world.count, np.bool_), np.zeros(world.count)

    def look(self) -> list[int]:
        """Take note of the newest frames.

        Returns:
            The rows whose episode began since the last look.
        """
        world, config = self._world, self._world.config
        # An episode is frozen: another object is another episode.
        fresh = [row for row, another in enumerate(map(is_not, self._episodes, world.episodes)) if another]
        for row in fresh:
            self._episodes[row] = world.episodes[row]
            self._captured[row] = -1
        _note(
            self._captured, world.captured, LEAD + config.warmup, float(config.rolling_shutter), config.stamped,
            world.time, self.rows, self.frame_time,
        )  # fmt: skip
        return fresh


@njit(cache=True, nogil=True)
def _note(known, captured, first, shutter, stamped, time, rows, frame_time):  # type: ignore[no-untyped-def]
    for i in range(rows.shape[0]):
        rows[i] = known[i] != captured[i]
        if rows[i]:
            known[i] = captured[i]
            frame_time[i] = (captured[i] - first) * PERIOD - 0.5 * shutter if stamped else time[i]
