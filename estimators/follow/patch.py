"""Color of a person from a picture, for trackers that use colors only."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


def patch_color(patch: ArrayLike, radius: float = 0.26) -> Array:
    """Mean color of the middle of square pictures of people.

    Args:
        patch: Pictures. Shape (*batch, S, S, 3), gray levels.
        radius: Radius of the person in a picture, as a share of its width. A larger radius averages noise, but
            includes the floor.

    Returns:
        Mean color. Shape (*batch, 3), gray levels.

    Raises:
        ValueError: Pictures of another shape, or values that are not finite.
    """
    pixels = as_numbers("patch", patch)
    if pixels.ndim < 3 or pixels.shape[-1] != 3 or pixels.shape[-2] != pixels.shape[-3] or not pixels.shape[-2]:
        raise ValueError(f"patch must have shape (*batch, S, S, 3), got {pixels.shape}")
    check_within("patch", pixels, LIMITS.scores, "replace such pixels")
    side = pixels.shape[-2]
    offset = (np.arange(side) + 0.5) / side - 0.5
    inside = np.hypot(offset[:, None], offset) < radius
    return pixels[..., inside, :].mean(axis=-2)
