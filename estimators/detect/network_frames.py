"""Frames as detection networks expect them, and their boxes back in the frame."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from servotrack.estimators.types import Array, Image


class Placement(NamedTuple):
    """Place of a frame in the input of a network: pixel x of the frame lies at `scale[0]` * x + `offset[0]`.

    Attributes:
        scale: Horizontal and vertical factor from frame to input.
        offset: Width of the left and of the upper border, px of the input.
        size: Width and height of the frame, px.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size: tuple[int, int]

    def to_frame(self, corners: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return corners (left, top, right, bottom), shape (k, 4), px, in the frame and within it.

        Args:
            corners: The same in the input of the network.
        """
        scales: NDArray[np.float32] = np.array([*self.scale, *self.scale], np.float32)
        moved = (corners - np.array([*self.offset, *self.offset], np.float32)) / scales
        width, height = self.size
        return np.clip(moved, 0.0, np.array([width, height, width, height], np.float32))


def letterbox(frame: Image, size: tuple[int, int], gray: int = 114) -> tuple[Image, Placement]:
    """Fit a frame into the input of a network with its shape kept, and fill the border with gray, as YOLO does.

    Args:
        frame: RGB, uint8, shape (H, W, 3).
        size: Width and height of the input, px.
        gray: Gray level of the border.

    Returns:
        The input, shape (height, width, 3), uint8, and the place of the frame in it.
    """
    height, width = frame.shape[:2]
    scale = min(size[1] / height, size[0] / width)
    inner = max(round(width * scale), 1), max(round(height * scale), 1)
    image = frame if (width, height) == inner else cv2.resize(frame, inner, interpolation=cv2.INTER_LINEAR)
    across, down = size[0] - inner[0], size[1] - inner[1]
    # An odd row or column of the border lies at the bottom or the right.
    left, top = across // 2, down // 2
    right, bottom = across - left, down - top
    boxed = cv2.copyMakeBorder(image, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(gray, gray, gray))
    # Rounding to whole px makes the two factors differ a little.
    scales = inner[0] / width, inner[1] / height
    return boxed, Placement(scales, (float(left), float(top)), (width, height))  # type: ignore[return-value]


def stretch(frame: Image, size: tuple[int, int], smooth: bool) -> tuple[Image, Placement]:
    """Resize a frame to the input of a network without regard to its shape, as transformers (DETR) do.

    Args:
        frame: RGB, uint8, shape (H, W, 3).
        size: Width and height of the input, px.
        smooth: True filters before it makes smaller, as Pillow does; False interpolates between four pixels, as OpenCV.

    Returns:
        The input, shape (height, width, 3), uint8, and the place of the frame in it.
    """
    height, width = frame.shape[:2]
    if smooth:
        image = np.asarray(PillowImage.fromarray(frame).resize(size, PillowImage.Resampling.BILINEAR))
    else:
        image = cv2.resize(frame, size, interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
    return image, Placement((size[0] / width, size[1] / height), (0.0, 0.0), (width, height))


def centered_corners(boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return corners (left, top, right, bottom) of boxes (center x, center y, width, height), shape (k, 4)."""
    half = boxes[:, 2:] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def non_maximum_suppression(
    corners: NDArray[np.float32],
    scores: NDArray[np.float32],
    classes: NDArray[np.int64],
    overlap: float,
    most: int,
    apart: float = 7680.0,
) -> NDArray[np.int64]:
    """Return the boxes that no better box of their class covers, best first, shape (m,).

    Args:
        corners: Left, top, right, bottom, shape (k, 4), px.
        scores: Shape (k,).
        classes: Shape (k,).
        overlap: Intersection over union above which the lower score is dropped. Raising it keeps more boxes.
        most: Largest number of boxes.
        apart: Distance by which classes are moved apart, px; it must exceed every input.

    References:
        Neubeck and Van Gool, "Efficient non-maximum suppression", ICPR 2006.
    """
    # Classes are moved apart instead of being treated one by one; rounding as in single precision.
    moved = corners + (classes.astype(np.float32) * np.float32(apart))[:, None]
    areas = (moved[:, 2] - moved[:, 0]) * (moved[:, 3] - moved[:, 1])
    rest = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(rest) and len(kept) < most:
        best, rest = rest[0], rest[1:]
        kept.append(int(best))
        low = np.maximum(moved[best, :2], moved[rest, :2])
        high = np.minimum(moved[best, 2:], moved[rest, 2:])
        shared = np.prod(np.maximum(high - low, np.float32(0.0)), axis=1)
        union = areas[best] + areas[rest] - shared
        ratio = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0.0)
        rest = rest[ratio <= overlap]
    return np.array(kept, np.int64)


def boxes_from_corners(corners: NDArray[np.float32]) -> Array:
    """Return left, top, width, height of corners (left, top, right, bottom), shape (k, 4)."""
    wide = corners.astype(np.float64)
    return np.concatenate([wide[:, :2], np.maximum(wide[:, 2:] - wide[:, :2], 0.0)], axis=1)
