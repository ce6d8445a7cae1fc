"""Contract of the trackers of one object: estimate, validation of frames, boxes and parameters, and random numbers.

A tracker is a frozen dataclass with `initial(frame, box) -> state` and `step(state, frame) -> (state, BoxEstimate)`.
States are values: a step returns a new one. `initial` reads the first frame, each `step` the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.detect.images import checked_image
from servotrack.estimators.types import Array, Image
from servotrack.estimators.validation import as_numbers


class BoxEstimate(NamedTuple):
    """Estimated box of the object.

    Attributes:
        box: Left, top, width and height. Shape (4,), px; pixel i spans i to i + 1.
        similarity: Similarity to the reference of the object, 0 to 1, by the method's own measure.
        particles: Candidate boxes, for methods that have them. Shape (n, 4), px.
        weights: Weights of the candidates, of sum 1. Shape (n,).
    """

    box: Array
    similarity: float
    particles: Array | None = None
    weights: Array | None = None


class Pose(NamedTuple):
    """A box by its center and its scale, in frames of one size.

    Attributes:
        center: Center of the box, shape (2,), px.
        scale: Scale of the box relative to the first one.
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
        """Boxes at the given centers (..., 2), px, and scales (...). Shape (..., 4), px."""
        size = scales[..., None] * self.size
        return np.concatenate([centers - size / 2.0, size], axis=-1)

    def within(self, centers: Array) -> Array:
        """Centers clipped to the frame. Shape (..., 2), px."""
        return np.minimum(np.maximum(centers, 0.0), self.shape[::-1])

    @staticmethod
    def bounded(scales: Array) -> Array:
        """Scales clipped to the range in which a box may shrink and grow."""
        # For a few hundred numbers NumPy's clip takes three times as long.
        return np.minimum(np.maximum(scales, SMALLEST_SCALE), LARGEST_SCALE)


SMALLEST_SCALE, LARGEST_SCALE = 0.1, 10.0
"""Limits of the scale of a box relative to the first one, for all trackers."""


def start(frame: ArrayLike, box: ArrayLike) -> tuple[Image, Array, Pose]:
    """Check the first frame and box and convert them.

    Args:
        frame: RGB (H, W, 3) or gray (H, W), uint8.
        box: Left, top, width and height, px.

    Returns:
        The frame as RGB, the box, shape (4,), px, and the box as a pose.

    Raises:
        ValueError: The frame is invalid, or the box has no area or lies outside the frame.
    """
    image = checked_frame(frame)
    first = checked_box(box, image.shape)
    return image, first, Pose(first[:2] + first[2:] / 2.0, 1.0, first[2:], (image.shape[0], image.shape[1]))


def checked_frame(frame: ArrayLike, shape: tuple[int, ...] | None = None) -> Image:
    """Check a frame and convert it to RGB.

    Args:
        frame: RGB of shape (H, W, 3) or gray of shape (H, W), uint8.
        shape: Required height and width; None for any.

    Returns:
        Shape (H, W, 3); gray becomes a color of three equal channels.

    Raises:
        ValueError: The frame is invalid or has another size than the first one.
    """
    image = checked_image(frame, "frame")
    if shape is not None and image.shape[:2] != shape:
        raise ValueError(
            f"frame must have the height and width {shape} of the first one, got {image.shape[:2]}; resize it, or "
            "start again with initial(frame, box)"
        )
    return image if image.ndim == 3 else np.ascontiguousarray(np.broadcast_to(image[..., None], (*image.shape, 3)))


def checked_box(box: ArrayLike, shape: tuple[int, ...], farthest: float = 1e6) -> Array:
    """Check the first box and convert it to an array of shape (4,), px.

    Args:
        box: Left, top, width and height, px.
        shape: Shape of the frame, beginning with height and width.
        farthest: Largest accepted magnitude of each number, px.

    Raises:
        ValueError: The box is not four finite numbers, is too large, or has no area or no pixel inside the frame.
    """
    try:
        values = np.array(as_numbers("box", box))
    except ValueError:
        values = np.zeros(0)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise ValueError(f"box must be four finite numbers, left, top, width, height, got {box!r}")
    if np.abs(values).max() > farthest:
        raise ValueError(f"box must lie within {farthest:g} px of the frame's corner, got {box!r}")
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
    """Standard normal numbers that depend only on (seed, frame), not on earlier draws.

    Args:
        seed: Seed of the tracker, at least 0.
        frame: Number of the frame.
        shape: Shape of the array.
    """
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, frame])).standard_normal(shape)


def uniforms(seed: int, frame: int, shape: tuple[int, ...]) -> Array:
    """Uniform numbers from 0 to 1 that depend only on (seed, frame); arguments as in `normals`."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 1, frame])).random(shape)


def check_fields(
    tracker: object, counts: Sequence[str] = (), positive: Sequence[str] = (), shares: Sequence[str] = ()
) -> None:
    """Raise ValueError if a field of a tracker is out of range, also `bins` and `seed` if it has them.

    Args:
        tracker: The dataclass of the tracker.
        counts: Names of the fields that are whole numbers of at least 1.
        positive: Names of the fields above 0.
        shares: Names of the fields from 0 to 1.
    """
    check_count(**{name: getattr(tracker, name) for name in counts})
    check_positive(**{name: getattr(tracker, name) for name in positive})
    check_shares(**{name: getattr(tracker, name) for name in shares})
    # The index of a bin, below bins ** 3, has to fit into 16 bits.
    for name, low, high in (("bins", 1, 16), ("seed", 0, 2**64 - 1)):
        value = getattr(tracker, name, low)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
            raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_positive(**values: float) -> None:
    """Raise ValueError if an argument is not finite and above 0."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be finite and above 0, got {value!r}")


def check_shares(**values: float) -> None:
    """Raise ValueError if an argument does not lie in [0, 1]."""
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} must lie in [0, 1], got {value!r}")


def check_count(**values: int) -> None:
    """Raise ValueError if an argument is not a whole number of at least 1."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
