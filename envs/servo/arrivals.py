"""Detection of new frames and new episodes since a sensor's last update, with the frames' time stamps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.servo.world import ServoWorld
from servotrack.envs.state import State, put, taken
from servotrack.estimators.compilation import njit


class Arrivals:
    """Newest frames of a world's N arms, as seen by one sensor.

    Args:
        world: World to observe; it is not changed.

    Attributes:
        rows: Mask of the arms with a new frame since the last update, (N,) bool.
        frame_time: Time stamps of the newest frames, (N,) s.
    """

    def __init__(self, world: ServoWorld) -> None:
        self._world = world
        self._begun = np.zeros(world.count, np.int64)
        self._captured = np.full(world.count, -1)
        self.rows, self.frame_time = np.zeros(world.count, np.bool_), np.zeros(world.count)

    def get_state(self) -> State:
        """Return what `set_state` needs: the newest frames' indices and time stamps."""
        return taken(self, ("_captured", "frame_time"))

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> list[int]:
        """Go back to a state, after the world. Returns the rows whose tables have to be loaded again.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        fresh: list[int] = np.flatnonzero(self._begun != self._world.begun).tolist()
        put(self, ("_captured", "frame_time"), state)
        self._begun[:] = self._world.begun
        return fresh

    def update(self) -> list[int]:
        """Register the newest frames.

        Returns:
            Rows whose episode began since the last update.
        """
        world, config = self._world, self._world.config
        fresh: list[int] = np.flatnonzero(self._begun != world.begun).tolist()
        self._begun[fresh] = world.begun[fresh]
        self._captured[fresh] = -1
        _register(
            self._captured, world.captured, LEAD + config.warmup, float(config.rolling_shutter), config.stamped,
            world.time, self.rows, self.frame_time,
        )  # fmt: skip
        return fresh


@njit(cache=True, nogil=True)
def _register(known, captured, first, shutter, stamped, time, rows, frame_time):  # type: ignore[no-untyped-def]
    for i in range(rows.shape[0]):
        rows[i] = known[i] != captured[i]
        if rows[i]:
            known[i] = captured[i]
            frame_time[i] = (captured[i] - first) * PERIOD - 0.5 * shutter if stamped else time[i]
