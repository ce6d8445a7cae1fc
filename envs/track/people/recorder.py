"""Recorder of one observer of a world with people: stores trails, numbers and errors for pictures."""

from __future__ import annotations

import numpy as np

from servotrack.envs.track.people.box_recorder import BoxRecorder
from servotrack.envs.track.people.box_render import draw
from servotrack.envs.track.people.world import PeopleWorld
from servotrack.estimators.types import Image

_MAX_PLOTTED = 1000
"""Maximum number of frames that the plots span."""


class PeopleRecorder:
    """Recorder of one observer. Call `record` after every reset and step; `frame` draws the last answered frame.

    Args:
        world: World to record; it is not changed.
        row: Index of the observer.
        show_truth: If True, the true boxes of scored people are drawn, too.
    """

    def __init__(self, world: PeopleWorld, row: int = 0, show_truth: bool = False) -> None:
        self._world, self._row, self._show_truth = world, row, show_truth
        self._boxes = BoxRecorder(min(world.horizon, _MAX_PLOTTED))
        self._answered = 0
        self._shown = self._newest = (world.images[row], np.empty((0, 4)))

    def record(self) -> None:
        """Store the newest answer and frame of the world. After a reset, drop the previous episode."""
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
        """Draw the last answered frame, or the first frame before any answer.

        Returns:
            New RGB image, uint8.
        """
        image, truth = self._shown
        return draw(self._boxes.scene(image, truth if self._show_truth else None, cutoff=self._world.cutoff))
