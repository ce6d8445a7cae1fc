"""Floor of the lobby, and the camera that observes it.

Floor coordinates are (x, z): x to the right of the camera's axis, z away from the camera, both m. The optical axis is
level and the lens is shifted, so that walls and people are upright in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.types import Array

MIN_DEPTH, MAX_DEPTH = 6.2, 15.0
"""Range of z in which people walk, m; at the default image size the scale is 26 to 65 px per meter."""
BACK_WALL = 15.6
"""z of the back wall, where the floor ends, m."""
BAY = 5.0
"""Distance between the doors in the back wall, m."""

_FOCAL = 400.0 / 288.0
"""Focal length in heights of the image."""
_HORIZON = 14.0 / 288.0
"""Row of the horizon in heights of the image."""
_CAMERA_HEIGHT = 4.0
"""Height of the camera above the floor, m."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera above the floor.

    Attributes:
        focal: Focal length, px.
        center: Column of the optical axis, px.
        horizon: Row of the horizon, px.
        elevation: Height of the pinhole above the floor, m.
        width: Width of the image, px.
    """

    focal: float
    center: float
    horizon: float
    elevation: float
    width: float

    def project(self, floor: Array) -> Array:
        """Project points of the floor (x, z), shape (..., 2), m, to columns and rows, shape (..., 2), px."""
        scale = self.scale(floor[..., 1])
        return np.stack([self.center + scale * floor[..., 0], self.horizon + scale * self.elevation], axis=-1)

    def unproject(self, pixels: Array) -> Array:
        """Map columns and rows below the horizon, shape (..., 2), px, to the floor (x, z), shape (..., 2), m."""
        z = self.focal * self.elevation / (pixels[..., 1] - self.horizon)
        return np.stack([(pixels[..., 0] - self.center) * z / self.focal, z], axis=-1)

    def scale(self, z: Array) -> Array:
        """Return the scale at a depth, px per m."""
        return self.focal / z

    def half_width(self, z: Array | float) -> Array:
        """Return half the width of the visible floor at a depth, m."""
        return np.asarray(0.5 * self.width / self.focal * z)


def lobby_camera(width: int, height: int) -> Camera:
    """Return the camera for an image size. A larger height scales the view; a larger width shows more.

    Args:
        width: Width of the image, px.
        height: Height of the image, px.
    """
    return Camera(_FOCAL * height, width / 2.0, _HORIZON * height, _CAMERA_HEIGHT, float(width))
