"""Automatic initialization of a tracker by motion (Zhang and Li 2008, step 1): the largest moving object is tracked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.color.contract import check_count, checked_frame
from servotrack.estimators.detect.detections import Detector
from servotrack.estimators.types import Array, Image


class Start(NamedTuple):
    """First frame and box for a tracker.

    Attributes:
        frame: Number of the frame, from 0.
        box: Left, top, width and height of the largest moving object, px.
        image: The frame as RGB, since a camera or an iterator does not return it again. Shape (H, W, 3), uint8.
    """

    frame: int
    box: Array
    image: Image


def start_from_motion(
    frames: Iterable[NDArray[np.uint8]], detector: Detector, background: int = 10, seen: int = 3
) -> Start:
    """Find the largest moving object.

    Args:
        frames: Frames, RGB or gray, uint8; no more are read than needed.
        detector: Detector of moving objects, such as `servotrack.estimators.detect.background.MaskedBackground`.
        background: Number of first frames from which the detector learns the background.
        seen: Number of consecutive frames with motion that are required; the box of the last one is returned. Raising
            it starts later and less often on noise.

    Raises:
        ValueError: There are too few frames, frames differ in size, or no motion lasts for `seen` frames.
    """
    check_count(background=background, seen=seen)
    source = iter(frames)
    first: list[Image] = []
    for _, frame in zip(range(background), source, strict=False):
        first.append(checked_frame(frame, first[0].shape[:2] if first else None))
    if len(first) < background:
        raise ValueError(f"frames must be more than the background's {background}, got {len(first)}")
    state, in_a_row = detector.initial(np.stack(first)), 0
    number = background - 1
    for number, frame in enumerate(source, background):
        image = checked_frame(frame, first[0].shape[:2])
        state, detections = detector.step(state, image)
        in_a_row = in_a_row + 1 if len(detections.boxes) else 0
        if in_a_row >= seen:
            return Start(number, detections.boxes[int(np.argmax(detections.areas))].copy(), image)
    raise ValueError(
        f"frames must show motion in {seen} consecutive frames, got none in {number + 1} frames; "
        "give a box, or use a more sensitive detector"
    )
