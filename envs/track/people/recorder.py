"""Watches one observer of a world of people and remembers what its picture needs."""

from __future__ import annotations

import numpy as np

from servotrack.envs.track.people.box_recorder import BoxRecorder
from servotrack.envs.track.people.box_render import draw
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.estimators.types import Image

_PLOTTED = 1000
"""Most frames that the plots span."""


class PeopleRecorder:
    """Call `record` after every reset and step; `frame` draws the frame that was answered last.

    Args:
        world: The world, which the recorder only reads.
        row: Which of its observers.
        show_truth: Whether the boxes of those who count are drawn, too.
    """

    def __init__(self, world: PeopleWorld, row: int = 0, show_truth: bool = False) -> None:
        self._world, self._row, self._show_truth = world, row, show_truth
        self._boxes = BoxRecorder(min(world.horizon, _PLOTTED))
        self._answered = 0
        self._shown = self._newest = (world.images[row], np.empty((0, 4)))

    def record(self) -> None:
        """Take the world's newest answer and frame; a reset forgets the old episode."""
        world, row, steps = self._world, self._row, int(self._world.steps[self._row])
        newest = (world.images[row], world.boxes[row][world.exists[row]])
        if steps == 0:
            self._boxes.reset()
            self._shown = newest
        elif steps > self._answered:
            scorer = world.scorer
            self._shown = self._newest
            self._boxes.record(
                scorer.labels[row],
                scorer.estimates[row],
                scorer.reported[row],
                true_number=len(self._shown[1]) if world.scored else None,
                error=float(world.ospa[row]) if world.scored else None,
            )
        self._answered, self._newest = steps, newest

    def frame(self) -> Image:
        """Draw the frame answered last, or the first one before any answer.

        Returns:
            A new RGB image, uint8.
        """
        image, truth = self._shown
        return draw(self._boxes.scene(image, truth if self._show_truth else None, cutoff=self._world.cutoff))
