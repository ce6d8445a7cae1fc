"""Recorder of a sonar scene: stores the waterfall, the answers and the errors for pictures."""

from __future__ import annotations

from collections import deque

import numpy as np

from servotrack.envs.track.sonar.render import MAX_RECORDS, Waterfall, draw
from servotrack.envs.track.sonar.world import SonarWorld
from servotrack.estimators.metrics import Track
from servotrack.estimators.types import Array, Image


class SonarRecorder:
    """Recorder of one scene. Call `record` after every reset and step; `frame` draws all answered records.

    Args:
        world: World to record; it is not changed.
        row: Index of the scene.
    """

    def __init__(self, world: SonarWorld, row: int = 0) -> None:
        self._world, self._row = world, row
        self._newest: Array = np.zeros(world.config.beams)
        self._records: deque[Array] = deque(maxlen=MAX_RECORDS)
        self._steps = 0
        self._errors: list[float] = []
        self._numbers: list[int] = []

    def record(self) -> None:
        """Store the newest record and answer of the world. After a reset, drop the previous episode."""
        world, row = self._world, self._row
        steps = int(world.steps[row])
        if steps == 0:
            self._records.clear()
            self._steps, self._errors, self._numbers = 0, [], []
        elif steps > self._steps:
            self._records.append(self._newest)
            self._steps = steps
            if world.scored[row]:
                self._errors.append(float(world.ospa[row]))
                self._numbers.append(int(world.scorer.reported[row].sum()))
        self._newest = world.observations[row].copy()

    def frame(self) -> Image:
        """Draw the answered records, or the first record before any answer.

        Returns:
            A new RGB image, shape (544, 800, 3), uint8.
        """
        world, row, config = self._world, self._row, self._world.config
        records = np.array(self._records if self._records else [self._newest])
        shown = max(self._steps, 1)
        scene = world.scene(row)
        exists, bearings = scene.exists[:shown], scene.bearings[:shown]
        truth = [
            Track(np.flatnonzero(exists[:, target]), bearings[exists[:, target], target, None])
            for target in np.flatnonzero(exists.any(axis=0)).tolist()
        ]
        return draw(
            Waterfall(
                records=records,
                first=shown - len(records),
                averages=config.averages,
                period=config.period,
                horizon=config.horizon + config.lag,
                tracks=list(enumerate(world.scorer.tracks(row))),
                truth=truth,
                true_numbers=exists[: len(self._errors)].sum(axis=1).astype(np.float64),
                reported_numbers=np.array(self._numbers, dtype=np.float64),
                errors=np.array(self._errors),
                cutoff=config.cutoff,
                scored=config.horizon,
            )
        )
