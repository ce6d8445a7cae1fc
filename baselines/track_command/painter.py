"""Frames of the annotated video: boxes and trails in identity colors, and the number of people over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servotrack.baselines.track_command.counts import Counter
from servotrack.baselines.track_command.inputs import Step
from servotrack.envs.track.files.recorded import PeopleInFrame, RecordedTracks
from servotrack.envs.track.people.box_recorder import BoxRecorder
from servotrack.envs.track.people.box_render import draw
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Image

_CANVAS = 74
"""Gray level of the canvas for a sequence without images."""


class BoxPainter:
    """Draw the boxes that a tracker reports into the source's frames, or onto a gray canvas if it has none.

    Args:
        size: Width and height of the source's frames, px.
        truth: True tracks, for the curve of the true number; None if unknown.
        show_truth: If true, draw the true boxes, too.
        counter: Counter of the run, whose zones, lines and numbers are drawn; None: none.
    """

    def __init__(
        self,
        size: tuple[int, int],
        truth: RecordedTracks | None = None,
        show_truth: bool = False,
        counter: Counter | None = None,
    ) -> None:
        self._size, self._show_truth, self._counter = size, show_truth, counter
        self._truth: Mapping[int, PeopleInFrame] | None = None if truth is None else truth.by_frame()
        self._recorder = BoxRecorder()

    def __call__(self, step: Step, estimate: SetEstimate) -> Image:
        """Return the annotated frame."""
        width, height = self._size
        picture = step.picture
        if picture is None:
            picture = np.full((height, width, 3), _CANVAS, np.uint8)
        people = None if self._truth is None else self._truth.get(step.number)
        number = None if self._truth is None else 0 if people is None else len(people.ids)
        self._recorder.record(
            np.concatenate([estimate.labels, estimate.held_labels]),
            np.concatenate([estimate.states, estimate.held_states]),
            np.arange(len(estimate.labels) + len(estimate.held_labels)) < len(estimate.labels),
            true_number=number,
            interval=None if self._counter is None else self._counter.people[1:],
        )
        places = () if self._counter is None else self._counter.marks()
        shown = people.boxes if people is not None and self._show_truth else None
        return draw(self._recorder.scene(picture, truth=shown, places=places))
