"""Validation of detector input images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Image
from servotrack.estimators.validation import as_array


def checked_image(image: ArrayLike, name: str = "frame", shape: tuple[int, ...] | None = None) -> Image:
    """Check an image and return it as a contiguous array, without a copy if it already is one.

    Args:
        image: RGB, shape (H, W, 3), or gray, shape (H, W); uint8.
        name: Name of the argument for error messages.
        shape: Required shape, that of the earlier frames; None for any.

    Returns:
        Shape (H, W, 3) or (H, W), uint8.

    Raises:
        ValueError: The image has another type or shape, or no pixels.
    """
    array = as_array(name, image)
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
    """Check one frame or several frames and return them as a list.

    Args:
        frames: One frame in the form of `checked_image`; or several of one shape: an array (k, H, W, 3) or a sequence.

    Raises:
        ValueError: There is no frame, frames differ in shape, or a frame is not a valid image.
    """
    if isinstance(frames, np.ndarray | np.generic | str | bytes) and np.ndim(frames) < 4:
        return [checked_image(frames, "frames")]
    try:
        several = list(frames)  # type: ignore[arg-type]
    except TypeError:
        raise ValueError(
            f"frames must be one frame or a sequence of frames, got {type(frames).__name__}; pass an array of shape "
            "(k, H, W, 3)"
        ) from None
    if not several:
        raise ValueError("frames must hold at least one frame, got none; check that the video could be read")
    first = checked_image(several[0], "frames[0]")
    return [checked_image(image, f"frames[{k}]", first.shape) for k, image in enumerate(several)]


def checked_stack(images: ArrayLike, square: bool = False) -> Image:
    """Check one RGB image or a stack of them, for detectors without a state.

    Args:
        images: RGB, uint8. Shape (*batch, H, W, 3).
        square: True if H and W must be equal.

    Returns:
        The same images as a contiguous array.

    Raises:
        ValueError: The images have another type or shape, or no pixels.
    """
    stack = as_array("images", images)
    wanted = "(*batch, S, S, 3)" if square else "(*batch, H, W, 3)"
    if (
        stack.dtype != np.uint8
        or stack.ndim < 3
        or stack.shape[-1] != 3
        or 0 in stack.shape[-3:-1]
        or (square and stack.shape[-3] != stack.shape[-2])
    ):
        raise ValueError(
            f"images must be uint8 of shape {wanted}, got {stack.dtype} {stack.shape}; convert other types to 0..255 "
            "with .astype(np.uint8)"
        )
    return np.ascontiguousarray(stack)
