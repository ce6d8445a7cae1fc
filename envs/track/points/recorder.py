"""Watches one observer of recorded points and remembers what its picture needs."""

from __future__ import annotations

import numpy as np

from servotrack.envs.drawing.plots import TRAIL_LENGTH
from servotrack.envs.track.clutter.recorder import SetRecorder
from servotrack.envs.track.clutter.render import TrackScene, Trail
from servotrack.envs.track.points.world import PointsWorld
from servotrack.estimators.types import Array


class PointsRecorder(SetRecorder):
    """Recorder of one observer of recorded points. The picture shows x and y about the middle of their region."""

    _world: PointsWorld

    def _answered(self) -> bool:
        world = self._world
        return bool(0 <= world.steps[self._row] - 1 - world.lag < world.horizon)

    def _scene(self, step: int) -> TrackScene:
        world, recording = self._world, self._world.recording
        low, high = recording.region
        shown = range(max(step + 1 - TRAIL_LENGTH, 0), step + 1)
        trails = [
            np.array([self._drawn(recording.positions[k, target]) for k in shown if recording.exists[k, target]])
            for target in np.flatnonzero(recording.exists[step])
        ]
        reported, held = self._trails()
        numbers = recording.exists[: step + 1].sum(axis=1) if recording.truth is not None else np.empty(0)
        return TrackScene(
            half_width=0.5 * float((high - low)[:2].max()),
            measurements=self._drawn(recording.points.scans[step]),
            truth=self._drawn(recording.positions[step, recording.exists[step]]),
            true_trails=trails,
            reported=[Trail(one.label, self._drawn(one.points)) for one in reported],
            held=[Trail(one.label, self._drawn(one.points)) for one in held],
            true_numbers=numbers.astype(np.float64),
            reported_numbers=np.array([int(r.sum()) for r in self._reported], dtype=np.float64),
            errors=np.array(self._errors),
            cutoff=world.cutoff,
            horizon=world.horizon,
        )

    def _drawn(self, positions: Array) -> Array:
        """Return x and y from the middle of the region, m."""
        low, high = self._world.recording.region
        return (positions - 0.5 * (low + high))[..., :2]
