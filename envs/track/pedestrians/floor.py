"""The lobby's floor, and the camera that looks along it.

Floor coordinates are (x, z): x to the right of the camera's axis, z away from the camera, both m. The camera's lens is
shifted, as architects' lenses are: its axis is level, so that walls and people stand upright in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.types import Array

NEAR, FAR = 6.2, 15.0
"""Where people walk, z in m; at the default size they are 26 to 65 px per meter."""
BACK_WALL = 15.6
"""Where the floor ends, z in m."""
BAY = 5.0
"""Doors stand at multiples of this along the back wall, m."""

_FOCAL = 400.0 / 288.0
"""Focal length in heights of the image."""
_HORIZON = 14.0 / 288.0
"""Row of the horizon in heights of the image."""
_CAMERA_HEIGHT = 4.0


@dataclass(frozen=True)
class Camera:
    """A pinhole above the floor.

    Attributes:
        focal: Focal length, px.
        center: Column of the optical axis, px.
        horizon: Row of the horizon, px.
        elevation: Of the pinhole above the floor, m.
        width: Of the image, px.
    """

    focal: float
    center: float
    horizon: float
    elevation: float
    width: float

    def project(self, floor: Array) -> Array:
        """Where points of the floor are seen: column and row, shape (..., 2), px, of (x, z), shape (..., 2), m."""
        scale = self.scale(floor[..., 1])
        return np.stack([self.center + scale * floor[..., 0], self.horizon + scale * self.elevation], axis=-1)

    def unproject(self, pixels: Array) -> Array:
        """Points of the floor (x, z), shape (..., 2), m, of columns and rows below the horizon, shape (..., 2), px."""
        z = self.focal * self.elevation / (pixels[..., 1] - self.horizon)
        return np.stack([(pixels[..., 0] - self.center) * z / self.focal, z], axis=-1)

    def scale(self, z: Array) -> Array:
        """Size of a meter at a depth, px."""
        return self.focal / z

    def half_width(self, z: Array | float) -> Array:
        """How far the image reaches to either side at a depth, m."""
        return np.asarray(0.5 * self.width / self.focal * z)


def lobby_camera(width: int, height: int) -> Camera:
    """The camera for a size of image; taller images are larger ones of the same view, wider ones see more.

    Args:
        width: px.
        height: px.
    """
    return Camera(_FOCAL * height, width / 2.0, _HORIZON * height, _CAMERA_HEIGHT, float(width))
