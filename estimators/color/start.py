"""Step 1 of paper 001 without a hand: the object to be tracked is what moves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.color.contract import check_count, checked_frame
from servotrack.estimators.types import Array, Image


class Start(NamedTuple):
    """Where tracking may begin.

    Attributes:
        frame: Number of the frame, from 0.
        box: Left, top, width and height of what moved most, px.
        image: The frame itself as RGB, which a camera or an iterator would not give again. Shape (H, W, 3), uint8.
    """

    frame: int
    box: Array
    image: Image


def start_from_motion(frames: Iterable[NDArray[np.uint8]], detector: Any, background: int = 10, seen: int = 3) -> Start:
    """Find the largest thing that moves.

    Args:
        frames: RGB or gray, uint8; only as many are taken as are needed.
        detector: With `initial(frames) -> state` and `step(state, frame) -> (state, detections)`, such as
            `servotrack.estimators.detect.background.MaskedBackground`.
        background: First frames that show the detector the background.
        seen: Frames in a row in which something has to move before it counts; the last one's box is taken.

    Raises:
        ValueError: Too few frames, frames of unlike sizes, or nothing that moved in `seen` frames in a row.
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
        f"frames must show something that moves in {seen} frames in a row, got none in {number + 1} frames; "
        "give a box, or a more sensitive detector"
    )
