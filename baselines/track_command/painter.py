"""The film's pictures: frames with boxes in identity colors and trails, and the number of people over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servotrack.baselines.track_command.inputs import Step
from servotrack.envs.track.files.recorded import PeopleInFrame, RecordedTracks
from servotrack.envs.track.people.box_recorder import BoxRecorder
from servotrack.envs.track.people.box_render import draw
from servotrack.estimators.rfs.sets import SetEstimate
from servotrack.estimators.types import Image

_CANVAS = 74
"""Gray level where a sequence has no images."""


class BoxPainter:
    """Paints what a tracker reports into the source's pictures; a sequence without images gets a plain canvas.

    Args:
        size: Width and height of the source's pictures, px.
        truth: Of the sequence, for the curve of the true number; None where it is unknown.
        show_truth: Whether true boxes are drawn, too.
    """

    def __init__(self, size: tuple[int, int], truth: RecordedTracks | None = None, show_truth: bool = False) -> None:
        self._size, self._show_truth = size, show_truth
        self._truth: Mapping[int, PeopleInFrame] | None = None if truth is None else truth.by_frame()
        self._recorder = BoxRecorder()

    def __call__(self, step: Step, estimate: SetEstimate) -> Image:
        """The picture of one frame."""
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
        )
        shown = people.boxes if people is not None and self._show_truth else None
        return draw(self._recorder.scene(picture, truth=shown))
