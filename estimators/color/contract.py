"""What all trackers of one object share: the estimate, what they take for a frame and a box, and their random numbers.

A tracker is a frozen dataclass with `initial(frame, box) -> state` and `step(state, frame) -> (state, BoxEstimate)`.
States are values: a step makes a new one. `initial` looks at the first frame, every `step` at the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.detect.images import Image, checked_image

Array = NDArray[np.float64]


class BoxEstimate(NamedTuple):
    """Where a tracker believes its object to be.

    Attributes:
        box: Left, top, width and height. Shape (4,), px; pixel i spans i to i + 1.
        similarity: With the object as it is remembered, 0 to 1, as the method measures it.
        particles: Boxes that were tried, where the method has them. Shape (n, 4), px.
        weights: Theirs, of sum 1. Shape (n,).
    """

    box: Array
    similarity: float
    particles: Array | None = None
    weights: Array | None = None


def checked_frame(frame: ArrayLike, shape: tuple[int, ...] | None = None) -> Image:
    """A frame as RGB.

    Args:
        frame: RGB of shape (H, W, 3) or gray of shape (H, W), uint8.
        shape: Height and width that it must have; None for any.

    Returns:
        Shape (H, W, 3); gray is a color of three equal channels.

    Raises:
        ValueError: Another type, shape or size than that of the first frame.
    """
    image = checked_image(frame, "frame")
    if shape is not None and image.shape[:2] != shape:
        raise ValueError(
            f"frame must have the height and width {shape} of the first one, got {image.shape[:2]}; resize it, or "
            "start again with initial(frame, box)"
        )
    return image if image.ndim == 3 else np.ascontiguousarray(np.broadcast_to(image[..., None], (*image.shape, 3)))


def checked_box(box: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A box to start from.

    Args:
        box: Left, top, width and height, px.
        shape: Height and width of the frame first.

    Raises:
        ValueError: Not four finite numbers, no area, or no pixel inside the frame.
    """
    values = np.array(box, dtype=np.float64)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ValueError(f"box must be four finite numbers, left, top, width, height, got {box!r}")
    left, top, width, height = values.tolist()
    if width < 1.0 or height < 1.0:
        raise ValueError(f"box must be at least 1 px wide and high, got width {width:g} and height {height:g}")
    rows, columns = shape[:2]
    if left + width < 1.0 or top + height < 1.0 or left > columns - 1.0 or top > rows - 1.0:
        raise ValueError(
            f"box must overlap the frame of {columns} x {rows} px, got left {left:g}, top {top:g}, width {width:g}, "
            f"height {height:g}"
        )
    return values


def middle(box: Array) -> Array:
    """Center of a box, or of each of several. Shape (..., 2), px."""
    return box[..., :2] + box[..., 2:] / 2.0


def box_about(center: Array, size: Array) -> Array:
    """Boxes from centers and sizes, each of shape (..., 2), px."""
    return np.concatenate([center - size / 2.0, size], axis=-1)


def normals(seed: int, frame: int, shape: tuple[int, ...]) -> Array:
    """Standard normal numbers that are a function of (seed, frame), whatever was drawn before.

    Args:
        seed: Of the tracker, at least 0.
        frame: Number of the frame.
        shape: Of the array.
    """
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, frame])).standard_normal(shape)


def within(center: Array, shape: tuple[int, ...]) -> Array:
    """A center, or several, no farther out than the frame's border. Shape (..., 2), px."""
    return np.clip(center, 0.0, np.array([shape[1], shape[0]], dtype=np.float64))


def check_positive(**values: float) -> None:
    """Raises ValueError, naming the argument, where one of them is not finite and above 0."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be finite and above 0, got {value!r}")


def check_shares(**values: float) -> None:
    """Raises ValueError, naming the argument, where one of them does not lie in [0, 1]."""
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must lie in [0, 1], got {value!r}")


def check_count(**values: int) -> None:
    """Raises ValueError, naming the argument, where one of them is no whole number of at least 1."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
