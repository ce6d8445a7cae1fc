"""Watches one row of a pedestrian world and remembers what its picture needs: trails, numbers and errors so far."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.box_paint import BoxTrail
from servotrack.envs.track.box_render import BoxScene, draw
from servotrack.envs.track.pedestrians.world import PedestrianWorld

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_TRAIL = 40
"""Frames of a trail."""


class _Seen(NamedTuple):
    """A frame, and the true boxes of those who count in it, shape (n, 4), px."""

    image: Image
    truth: Array


class Recorder:
    """Call `record` after every reset and step; `frame` draws the frame that was answered last.

    Args:
        world: The world, which the recorder only reads.
        row: Which of its scenes.
        show_truth: Whether true boxes are drawn, too.
    """

    def __init__(self, world: PedestrianWorld, row: int = 0, show_truth: bool = False) -> None:
        self._world, self._row, self._show_truth = world, row, show_truth
        self._labels: list[NDArray[np.int64]] = []
        self._reported: list[NDArray[np.bool_]] = []
        self._estimates: list[Array] = []
        self._errors: list[float] = []
        self._numbers: list[int] = []
        self._newest = _Seen(world.images[row], np.empty((0, 4)))
        self._answered: _Seen | None = None

    def record(self) -> None:
        """Take the world's newest answer and frame; a reset forgets the old episode."""
        world, row = self._world, self._row
        if world.steps[row] == 0:
            self._labels, self._reported, self._estimates, self._errors, self._numbers = [], [], [], [], []
            self._answered = None
        elif len(self._errors) < world.steps[row]:
            self._answered = self._newest
            self._labels.append(world.scorer.labels[row].copy())
            self._reported.append(world.scorer.reported[row].copy())
            self._estimates.append(world.scorer.estimates[row].copy())
            self._errors.append(float(world.ospa[row]))
            self._numbers.append(len(self._answered.truth))
        self._newest = _Seen(world.images[row], world.boxes[row][world.exists[row]])

    def frame(self) -> Image:
        """Draw the frame answered last, or the first one before any answer.

        Returns:
            A new RGB image, uint8.
        """
        world, config = self._world, self._world.config
        seen = self._newest if self._answered is None else self._answered
        reported, held = self._trails()
        return draw(
            BoxScene(
                frame=seen.image,
                reported=reported,
                held=held,
                truth=seen.truth if self._show_truth else np.empty((0, 4)),
                reported_numbers=np.array([int(r.sum()) for r in self._reported], dtype=np.float64),
                true_numbers=np.array(self._numbers, dtype=np.float64),
                errors=np.array(self._errors),
                cutoff=world.config.score_cutoff,
                horizon=config.horizon,
            )
        )

    def _trails(self) -> tuple[list[BoxTrail], list[BoxTrail]]:
        """Trails of the identities that are reported now, and of those held silently."""
        reported: list[BoxTrail] = []
        held: list[BoxTrail] = []
        if not self._labels:
            return reported, held
        recent = range(len(self._labels) - 1, max(len(self._labels) - 1 - _TRAIL, -1), -1)
        for number, label in enumerate(self._labels[-1].tolist()):
            if label < 0:
                continue
            # A row keeps its identity, so that its past is in the same row.
            past = [self._estimates[k][number] for k in recent if self._labels[k][number] == label]
            trail = BoxTrail(label, np.array(past[::-1]))
            (reported if self._reported[-1][number] else held).append(trail)
        return reported, held
