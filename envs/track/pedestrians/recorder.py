"""Watches one row of a pedestrian world and remembers what its picture needs: trails, numbers and errors so far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.box_paint import BoxTrail
from servotrack.envs.track.box_render import BoxScene, draw
from servotrack.envs.track.pedestrians.world import PedestrianWorld

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_TRAIL = 40
"""Frames of a trail."""


class Recorder:
    """Call `record` after every reset and step; `frame` draws the frame that was answered last.

    Args:
        world: The world, which the recorder only reads.
        row: Which of its scenes.
        show_truth: Whether true boxes are drawn, too.
    """

    def __init__(self, world: PedestrianWorld, row: int = 0, show_truth: bool = False) -> None:
        self._world, self._row, self._show_truth = world, row, show_truth
        self._forget()

    def record(self) -> None:
        """Take the world's newest answer and frame; a reset forgets the old episode."""
        world, row = self._world, self._row
        if world.steps[row] == 0:
            self._forget()
        elif len(self._errors) < world.steps[row]:
            self._shown, self._shown_truth = self._newest, self._newest_truth
            self._labels.append(world.scorer.labels[row].copy())
            self._reported.append(world.scorer.reported[row].copy())
            self._estimates.append(world.scorer.estimates[row].copy())
            self._errors.append(float(world.ospa[row]))
            self._numbers.append(int(self._newest_count))
        self._newest, self._newest_truth = world.images[row], world.boxes[row][world.exists[row]]
        self._newest_count = int(world.exists[row].sum())

    def frame(self) -> Image:
        """Draw the frame answered last, or the first one before any answer.

        Returns:
            A new RGB image, uint8.
        """
        world, config = self._world, self._world.config
        image = self._newest if self._shown is None else self._shown
        truth = self._newest_truth if self._shown is None else self._shown_truth
        reported, held = self._trails()
        return draw(
            BoxScene(
                frame=image,
                reported=reported,
                held=held,
                truth=truth if self._show_truth else np.empty((0, 4)),
                reported_numbers=np.array([int(r.sum()) for r in self._reported], dtype=np.float64),
                true_numbers=np.array(self._numbers, dtype=np.float64),
                errors=np.array(self._errors),
                cutoff=world.config.score_cutoff,
                horizon=config.horizon,
            )
        )

    def _forget(self) -> None:
        self._labels: list[NDArray[np.int64]] = []
        self._reported: list[NDArray[np.bool_]] = []
        self._estimates: list[Array] = []
        self._errors: list[float] = []
        self._numbers: list[int] = []
        self._shown: Image | None = None
        self._newest: Image = self._world.images[self._row]
        self._newest_truth = self._shown_truth = np.empty((0, 4))
        self._newest_count = 0

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
