"""Detections of a file in px: an empty file is refused, coordinates of 0 to 1 are scaled to the frame."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.files.mot_files import MotDetections, read_mot_detections
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array

_REACH = 2.0
"""Largest coordinate of normalized boxes. Boxes may lie outside the frame in part."""
_INSIDE = 0.95
"""Share of the boxes that must lie within it."""


class PixelDetections(NamedTuple):
    """Detections of a sequence.

    Attributes:
        found: Detections by step, px.
        note: Change of the coordinates, for the user; empty for none.
    """

    found: MotDetections
    note: str


def read_pixel_detections(path: Path, size: tuple[int, int] | None) -> PixelDetections:
    """Read a det.txt for use as detections in px.

    Args:
        path: File in MOTChallenge format.
        size: Width and height of the frames, px; None if unknown.

    Raises:
        SequenceError: The file is invalid or holds no rows, or holds normalized coordinates and the size is unknown.
    """
    found = read_mot_detections(path)
    if not len(found):
        raise SequenceError(
            f"{path} holds no detections: the detector that wrote it failed or found nothing; run it again, or choose "
            "another --detector"
        )
    if not is_normalized(found.boxes):
        return PixelDetections(found, "")
    if size is None:
        raise SequenceError(
            f"{path} holds coordinates from 0 to 1, and the size of the frames is unknown; add imWidth and imHeight to "
            "seqinfo.ini, or write the file in px"
        )
    note = (
        f"{path} holds coordinates from 0 to 1: they are taken as left, top, width and height of frames of "
        f"{size[0]}x{size[1]} px"
    )
    return PixelDetections(found.scaled(*size), note)


def is_normalized(boxes: Array) -> bool:
    """Return True if boxes are fractions of the frame: most are smaller than a pixel and lie near the unit square.

    Args:
        boxes: Left, top, width and height, shape (n, 4), n at least 1.
    """
    sizes, ends = boxes[:, 2:], boxes[:, :2] + boxes[:, 2:]
    near = (np.abs(boxes[:, :2]).max(axis=1) <= _REACH) & (ends.max(axis=1) <= _REACH)
    return bool((np.median(sizes, axis=0) < 1.0).all() and sizes.max() > 0.0 and near.mean() >= _INSIDE)
