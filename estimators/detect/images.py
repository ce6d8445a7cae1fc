"""What a detector takes for an image, and a clear word about everything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Image


def checked_image(image: ArrayLike, name: str = "frame", shape: tuple[int, ...] | None = None) -> Image:
    """The image as a contiguous array, the caller's own memory where it already is one.

    Args:
        image: RGB, shape (H, W, 3), or gray, shape (H, W); uint8.
        name: What the caller calls it, for the message.
        shape: The shape that it must have, that of the frames before it; None for any.

    Returns:
        Shape (H, W, 3) or (H, W), uint8.

    Raises:
        ValueError: Another type or shape, an image without pixels, or a change of size.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8:
        remedy = {
            "u": "shift it down to 8 bits, as in (frame >> 8).astype(np.uint8)",
            "f": "scale it to 0..255, replace NaN, and convert it with .astype(np.uint8)",
        }.get(array.dtype.kind, "convert it to 8 bits")
        raise ValueError(f"{name} must be uint8, got {array.dtype} {array.shape}; {remedy}")
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(
            f"{name} must be RGB of shape (H, W, 3) or gray of shape (H, W), got {array.shape}; drop an alpha channel "
            "with frame[..., :3]"
        )
    if 0 in array.shape:
        raise ValueError(f"{name} must have pixels, got shape {array.shape}; skip frames that could not be decoded")
    if shape is not None and array.shape != shape:
        raise ValueError(
            f"{name} must have the shape {shape} of the frames before it, got {array.shape}; resize it, or start again "
            "with initial(frame)"
        )
    return np.ascontiguousarray(array)


def checked_images(frames: ArrayLike | Sequence[ArrayLike]) -> list[Image]:
    """One frame or several as a list.

    Args:
        frames: One frame, as `checked_image` takes it; or several of one shape: an array (k, H, W, 3) or a sequence.

    Raises:
        ValueError: No frame, frames of unlike shapes, or not such images.
    """
    if isinstance(frames, np.ndarray) and frames.ndim < 4:
        return [checked_image(frames, "frames")]
    several = list(frames)  # type: ignore[arg-type]
    if not several:
        raise ValueError("frames must hold at least one frame, got none; check that the video could be read")
    first = checked_image(several[0], "frames[0]")
    return [checked_image(image, f"frames[{k}]", first.shape) for k, image in enumerate(several)]
