"""Motion of the camera from the pictures: a similarity that most corners of the background follow.

Corners are followed by pyramids of Lucas and Kanade (1981), away from the people of the last frame; the similarity is
the one that most of them agree with (random sample consensus, Fischler and Bolles 1981).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.camera_motion import small_copy
from servotrack.estimators.detect.detections import detections_from_boxes
from servotrack.estimators.detect.images import checked_image
from servotrack.estimators.types import Array, Image

STILL = np.eye(2, 3)
"""Motion of a picture that stands still."""


class PictureMotionState(NamedTuple):
    """State of a `PictureMotion`.

    Attributes:
        small: Small gray copy of the last frame; None before the first one. uint8.
        boxes: Boxes of the last frame in px of the copy: left, top, right, bottom. Shape (k, 4).
    """

    small: Image | None
    boxes: Array


@dataclass(frozen=True)
class PictureMotion:
    """Estimator of the motion of the camera between frames.

    Args:
        width: Largest width of the small copies, px. Raising it finds smaller motion and takes longer.
        corners: Largest number of corners.
        weakest: Smallest strength of a corner, medians of the strongest in parts of the picture. Raising it leaves
            fewer.
        least_corners: Smallest number of corners that must agree.
        window: Width of the window in which a corner is followed, px of the copy. Raising it needs less texture and
            comes nearer to what moves by itself.
        agree: Smallest share of the followed corners that must agree, in (0, 1]; with fewer the motion is unknown.
        tolerance: Largest distance of a corner from where the similarity puts it, px of the copy.
        quiet: Largest displacement of a corner of the picture that counts as none, px of the copy. A still camera stays
            still, in spite of noise.

    Raises:
        ValueError: A number is out of range.
    """

    width: int = 320
    corners: int = 160
    weakest: float = 0.1
    least_corners: int = 8
    window: int = 15
    agree: float = 0.4
    tolerance: float = 0.7
    quiet: float = 0.15

    def __post_init__(self) -> None:
        for name, least in (("width", 16), ("corners", 8), ("least_corners", 3), ("window", 5)):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= least):
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
        if not 0.0 < self.agree <= 1.0:
            raise ValueError(f"agree must be in (0, 1], got {self.agree!r}")
        for name in ("tolerance", "quiet", "weakest"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be at least 0 and finite, got {getattr(self, name)!r}")

    def initial(self) -> PictureMotionState:
        """State before the first frame."""
        return PictureMotionState(None, np.zeros((0, 4)))

    def step(
        self, state: PictureMotionState, frame: ArrayLike, boxes: ArrayLike
    ) -> tuple[PictureMotionState, Array | None]:
        """Estimate the motion from the last frame to this one.

        Args:
            state: State after the last frame.
            frame: RGB or gray, uint8. Shape (H, W, 3) or (H, W).
            boxes: Left, top, width, height of what moves by itself in this frame, px. Shape (k, 4).

        Returns:
            The state, and the motion: maps a point (x, y, 1) of the last frame to this one, px. Shape (2, 3). None
            where it is unknown: in the first frame, and in pictures without texture or with too few corners that agree.

        Raises:
            ValueError: The frame is not an image, or boxes are not finite or of another shape.
        """
        image = checked_image(frame)
        small = small_copy(image, self.width)
        scale = image.shape[1] / small.shape[1]
        found = detections_from_boxes(boxes).boxes / scale
        after = PictureMotionState(small, np.concatenate([found[:, :2], found[:, :2] + found[:, 2:]], axis=1))
        if state.small is None or state.small.shape != small.shape:
            return after, None
        motion = self._similarity(state.small, small, state.boxes)
        if motion is None:
            return after, None
        height, width = small.shape
        ends = np.array([[0.0, 0.0, 1.0], [width, 0.0, 1.0], [0.0, height, 1.0], [width, height, 1.0]])
        if np.abs(ends @ motion.T - ends[:, :2]).max() <= self.quiet:
            return after, STILL
        return after, np.column_stack([motion[:, :2], motion[:, 2] * scale])

    def _similarity(self, before: Image, now: Image, boxes: Array) -> Array | None:
        free = np.full(before.shape, 255, np.uint8)
        # The window in which a corner is followed must not reach into what moves by itself.
        around = boxes + np.array([-1.0, -1.0, 1.0, 1.0]) * (self.window // 2)
        for left, top, right, bottom in np.clip(around, 0.0, max(before.shape)).astype(np.int64):
            free[top : bottom + 1, left : right + 1] = 0
        start = self._corners(before, free)
        if len(start) < self.least_corners:
            return None
        motion = self._followed(before, now, start, np.zeros(2))
        if motion is None:
            # A jolt is too far for corners to be found again from where they were.
            jolt, _ = cv2.phaseCorrelate(before.astype(np.float32), now.astype(np.float32), _window(before.shape))
            motion = self._followed(before, now, start, np.array(jolt))
        return motion

    def _followed(self, before: Image, now: Image, start: NDArray[np.float32], guess: Array) -> Array | None:
        """Similarity that the corners follow, searched for near a shift."""
        ends = (start + guess).astype(np.float32)
        followed, seen, _ = cv2.calcOpticalFlowPyrLK(
            before, now, start, ends, winSize=(self.window, self.window), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        kept = np.ravel(seen) == 1
        if kept.sum() < self.least_corners:
            return None
        # The random numbers of OpenCV's consensus are the same in every call.
        motion, agreeing = cv2.estimateAffinePartial2D(
            start[kept], np.asarray(followed)[kept], method=cv2.RANSAC, ransacReprojThreshold=self.tolerance
        )
        if motion is None or agreeing is None:
            return None
        number = int(np.sum(agreeing))
        if number < self.least_corners or number < self.agree * len(start):
            return None
        return np.asarray(motion, dtype=np.float64)

    def _corners(self, image: Image, free: Image) -> NDArray[np.float32]:
        """Strongest corners where `free` is not 0. Shape (k, 1, 2), float32."""
        strength = cv2.cornerMinEigenVal(image, 3)
        strength[free == 0] = 0.0
        # Strong compared with the middle of the picture's parts: a bright person must not put out the whole ground.
        parts = cv2.resize(cv2.dilate(strength, np.ones((9, 9))), (8, 6), interpolation=cv2.INTER_NEAREST)
        reach = 2 * max(round(image.shape[1] / 80.0), 1) + 1
        peaks = (strength == cv2.dilate(strength, np.ones((reach, reach)))) & (
            strength > self.weakest * np.median(parts)
        )
        rows, columns = np.nonzero(peaks)
        best = np.argsort(-strength[rows, columns], kind="stable")[: self.corners]
        return np.stack([columns[best], rows[best]], axis=1).astype(np.float32)[:, None]


@lru_cache(maxsize=4)
def _window(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Window that fades out the border of a picture, whose sides do not fit together."""
    return np.asarray(cv2.createHanningWindow((shape[1], shape[0]), cv2.CV_32F), dtype=np.float32)
