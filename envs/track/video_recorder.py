"""Watches one observer of a recorded sequence and remembers what its picture needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.box_recorder import BoxRecorder
from servotrack.envs.track.box_render import draw
from servotrack.envs.track.video_world import VideoWorld

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_PLOTTED = 300
"""Frames that the plots span."""


class VideoRecorder:
    """Call `record` after every reset and step; `frame` draws the frame that was answered last.

    Args:
        world: The world, which the recorder only reads.
        row: Which of its observers.
    """

    def __init__(self, world: VideoWorld, row: int = 0) -> None:
        self._world, self._row = world, row
        self._boxes = BoxRecorder(min(world.recording.horizon, _PLOTTED))
        self._answered = 0
        self._shown = self._newest = world.images[row]
        self._people = 0

    def record(self) -> None:
        """Take the world's newest answer and frame; a reset forgets the old episode."""
        world, row = self._world, self._row
        steps, scored = int(world.steps[row]), world.recording.scored
        if steps == 0:
            self._boxes.reset()
            self._shown = world.images[row]
        elif steps > self._answered:
            scorer = world.scorer
            self._boxes.record(
                scorer.labels[row],
                scorer.estimates[row],
                scorer.reported[row],
                true_number=self._people if scored else None,
                error=float(world.ospa[row]) if scored else None,
            )
            self._shown = self._newest
        self._answered, self._newest = steps, world.images[row]
        self._people = int(world.exists[row].sum())

    def frame(self) -> Image:
        """Draw the frame answered last, or the first one before any answer.

        Returns:
            A new RGB image, uint8.
        """
        return draw(self._boxes.scene(self._shown, cutoff=self._world.config.cutoff))
