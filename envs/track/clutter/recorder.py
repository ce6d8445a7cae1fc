"""Watches one row of a clutter world and remembers what its picture needs: trails, numbers and errors so far."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from servotrack.envs.drawing.plots import TRAIL_LENGTH
from servotrack.envs.track.clutter.render import TrackScene, Trail, draw
from servotrack.envs.track.clutter.world import ClutterWorld
from servotrack.envs.track.set_world import SetWorld
from servotrack.estimators.types import Array, Image, Labels, Mask


class SetRecorder(ABC):
    """Recorder of one scene. Call `record` after every reset and step; `frame` draws the last answered scan.

    Args:
        world: World to record; it is not changed.
        row: Index of the scene.
    """

    def __init__(self, world: SetWorld, row: int = 0) -> None:
        self._world, self._row = world, row
        self._labels: list[Labels] = []
        self._reported: list[Mask] = []
        self._estimates: list[Array] = []
        self._errors: list[float] = []

    def record(self) -> None:
        """Store the newest answer of the world. After a reset, drop the previous episode."""
        world, row = self._world, self._row
        if world.steps[row] == 0:
            self._labels, self._reported, self._estimates, self._errors = [], [], [], []
            return
        if not self._answered():
            return
        self._labels.append(world.scorer.labels[row].copy())
        self._reported.append(world.scorer.reported[row].copy())
        self._estimates.append(world.scorer.estimates[row].copy())
        if world.scored[row]:
            self._errors.append(float(world.ospa[row]))

    def frame(self) -> Image:
        """Draw the last answered scan, or the first scan before any answer.

        Returns:
            A new RGB image, shape (544, 800, 3), uint8.
        """
        world = self._world
        # The answer was for this scan; with a lag it is not the newest one.
        return draw(self._scene(max(min(int(world.steps[self._row]) - world.lag, world.horizon) - 1, 0)))

    def _answered(self) -> bool:
        """Return True if the last answer was for a scan of the episode."""
        return bool(self._world.scored[self._row])

    @abstractmethod
    def _scene(self, step: int) -> TrackScene:
        """Return the content of the picture of a scan."""

    def _trails(self) -> tuple[list[Trail], list[Trail]]:
        """Return the trails of reported identities, and of those that are held without being reported."""
        reported: list[Trail] = []
        held: list[Trail] = []
        if not self._labels:
            return reported, held
        recent = range(len(self._labels) - 1, max(len(self._labels) - 1 - TRAIL_LENGTH, -1), -1)
        for number, label in enumerate(self._labels[-1].tolist()):
            if label < 0:
                continue
            # An identity stays in its row, so that its past is in the same row.
            past = [self._estimates[k][number] for k in recent if self._labels[k][number] == label]
            trail = Trail(label, np.array(past[::-1]))
            (reported if self._reported[-1][number] else held).append(trail)
        return reported, held


class Recorder(SetRecorder):
    """Recorder of one scene of a clutter world."""

    _world: ClutterWorld

    def _scene(self, step: int) -> TrackScene:
        world, row, config = self._world, self._row, self._world.config
        scan, _, states, exists = world.scan(row, step)
        seen = scan[scan[:, 0] > 0.5, 1:]
        lines = np.empty((0, 2, 2))
        if config.sensor == "range-bearing":
            sensor = np.array(config.sensor_position)
            seen = sensor + seen[:, :1] * np.stack([np.cos(seen[:, 1]), np.sin(seen[:, 1])], axis=1)
            lines = np.stack([np.broadcast_to(sensor, seen.shape), seen], axis=1)
        tracks = world.true_tracks(row)[:, max(step + 1 - TRAIL_LENGTH, 0) : step + 1]
        reported, held = self._trails()
        numbers = [int(world.scan(row, k)[3].sum()) for k in range(step + 1)]
        return TrackScene(
            half_width=config.half_width,
            measurements=seen,
            truth=states[exists][:, [0, 2]],
            true_trails=[track[~np.isnan(track[:, 0])] for track in tracks[exists]],
            reported=reported,
            held=held,
            true_numbers=np.array(numbers, dtype=np.float64),
            reported_numbers=np.array([int(r.sum()) for r in self._reported], dtype=np.float64),
            errors=np.array(self._errors),
            cutoff=config.cutoff,
            horizon=config.horizon,
            sensor_lines=lines,
        )
