"""What the picture of a person tells a tracker that sees colors only."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.types import Array

_BODY = 0.26
"""Radius of the person in a picture, as a share of its width."""


def patch_color(patch: ArrayLike) -> Array:
    """Mean color of the middle of square pictures of persons.

    Args:
        patch: Shape (*batch, S, S, 3), gray levels.

    Returns:
        Shape (*batch, 3), gray levels.
    """
    pixels = np.asarray(patch, dtype=np.float64)
    side = pixels.shape[-2]
    offset = (np.arange(side) + 0.5) / side - 0.5
    inside = np.hypot(offset[:, None], offset) < _BODY
    return pixels[..., inside, :].mean(axis=-2)
