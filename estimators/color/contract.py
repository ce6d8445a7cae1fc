"""What all trackers of one object share: the estimate, what they take for a frame and a box, and their random numbers.

A tracker is a frozen dataclass with `initial(frame, box) -> state` and `step(state, frame) -> (state, BoxEstimate)`.
States are values: a step makes a new one. `initial` looks at the first frame, every `step` at the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.detect.images import checked_image
from servotrack.estimators.types import Array, Image


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


class Pose(NamedTuple):
    """A box by its center and its scale, in frames of one size.

    Attributes:
        center: Of the box, shape (2,), px.
        scale: Of the box, 1 for the first one.
        size: Width and height of the first box, px.
        shape: Height and width of the frames.
    """

    center: Array
    scale: float
    size: Array
    shape: tuple[int, int]

    @property
    def box(self) -> Array:
        """Left, top, width and height. Shape (4,), px."""
        return self.boxes(self.center, np.array(self.scale))

    def boxes(self, centers: Array, scales: Array) -> Array:
        """Boxes at other centers (..., 2), px, and scales (...). Shape (..., 4), px."""
        size = scales[..., None] * self.size
        return np.concatenate([centers - size / 2.0, size], axis=-1)

    def within(self, centers: Array) -> Array:
        """Centers no farther out than the frame's border. Shape (..., 2), px."""
        return np.minimum(np.maximum(centers, 0.0), self.shape[::-1])

    @staticmethod
    def bounded(scales: Array) -> Array:
        """Scales no farther from 1 than a box may shrink and grow."""
        # On a few hundred numbers NumPy's clip takes three times as long.
        return np.minimum(np.maximum(scales, SMALLEST_SCALE), LARGEST_SCALE)


SMALLEST_SCALE, LARGEST_SCALE = 0.1, 10.0
"""How far a box may shrink and grow against the first one."""
_MOST_BINS = 16
"""Of each color channel."""
_FARTHEST = 1e6
"""A box's numbers may be as large as this, px."""


def start(frame: ArrayLike, box: ArrayLike) -> tuple[Image, Array, Pose]:
    """What every tracker takes from the first frame.

    Args:
        frame: RGB (H, W, 3) or gray (H, W), uint8.
        box: Left, top, width and height, px.

    Returns:
        The frame as RGB, the box, shape (4,), px, and the same as a pose.

    Raises:
        ValueError: No such frame, or a box without area or outside of it.
    """
    image = checked_frame(frame)
    first = checked_box(box, image.shape)
    return image, first, Pose(first[:2] + first[2:] / 2.0, 1.0, first[2:], (image.shape[0], image.shape[1]))


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
        ValueError: Not four finite numbers, too large ones, no area, or no pixel inside the frame.
    """
    try:
        values = np.array(box, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ValueError(f"box must be four finite numbers, left, top, width, height, got {box!r}")
    if np.abs(values).max() > _FARTHEST:
        raise ValueError(f"box must lie within {_FARTHEST:g} px of the frame's corner, got {box!r}")
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


def normals(seed: int, frame: int, shape: tuple[int, ...]) -> Array:
    """Standard normal numbers that are a function of (seed, frame), whatever was drawn before.

    Args:
        seed: Of the tracker, at least 0.
        frame: Number of the frame.
        shape: Of the array.
    """
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, frame])).standard_normal(shape)


def check_fields(
    tracker: Any, counts: Sequence[str] = (), positive: Sequence[str] = (), shares: Sequence[str] = ()
) -> None:
    """Raises ValueError, naming it, where a tracker's field is not what it has to be; bins and seed where it has them.

    Args:
        tracker: The dataclass.
        counts: Names of its whole numbers of at least 1.
        positive: Names of its numbers above 0.
        shares: Names of its numbers from 0 to 1.
    """
    check_count(**{name: getattr(tracker, name) for name in counts})
    check_positive(**{name: getattr(tracker, name) for name in positive})
    check_shares(**{name: getattr(tracker, name) for name in shares})
    for name, low, high in (("bins", 1, _MOST_BINS), ("seed", 0, 2**64 - 1)):
        value = getattr(tracker, name, low)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
            raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


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
