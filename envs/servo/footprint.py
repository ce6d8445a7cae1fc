"""Footprint of the camera on the floor, and the floor's grid lines in the camera's image."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from servotrack.estimators.camera import ground_point, project
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

GRID_SPACING = 0.2
"""Distance of the floor's grid lines, m."""

_BORDER_POINTS = 12  # per side of the image: enough for the curved border of a distorted image
_SPARSE_REACH = 1.6  # grids that reach farther from the tool than this (m) have every second line
_STRAIGHT_POINTS, _CURVED_POINTS = 13, 25  # per line, without and with distortion
_LEAST_REACH, _LARGEST_REACH = 0.4, 2.4  # bounds of the distance from the tool to the end of the grid, m


@lru_cache(maxsize=8)
def _border(size: int) -> Array:
    """Pixels along the image's border, shape (4 * _BORDER_POINTS, 2)."""
    along = np.arange(_BORDER_POINTS) / _BORDER_POINTS * size
    zero, full = np.zeros_like(along), np.full_like(along, size)
    sides = [(along, zero), (full, along), (size - along, full), (zero, size - along)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


@njit(cache=True, nogil=True)
def _footprint(cam, l1, l2, theta1, theta2, border, farthest, out):  # type: ignore[no-untyped-def]
    phi = theta1 + theta2
    c2, s2 = math.cos(phi), math.sin(phi)
    tx = l1 * math.cos(theta1) + l2 * c2
    ty = l1 * math.sin(theta1) + l2 * s2
    c = c2 * cam[5] - s2 * cam[6]
    s = s2 * cam[5] + c2 * cam[6]
    for i in range(border.shape[0]):
        gx, gy = ground_point(cam, border[i, 0], border[i, 1])
        shrink = min(1.0, farthest / max(math.hypot(gx, gy), 1e-9))
        gx *= shrink
        gy *= shrink
        out[i, 0] = tx + c * gx + s * gy
        out[i, 1] = ty + s * gx - c * gy


def camera_footprint(camera: Array, links: Array, joint_angles: Array, camera_size: int) -> Array:
    """Outline of the floor area in the camera's view.

    Args:
        camera: One packed camera, shape (CAMERA_SIZE,).
        links: Link lengths, shape (2,), m.
        joint_angles: Joint angles, shape (2,), rad.
        camera_size: Width and height of the image, px.

    Returns:
        Corners of a closed polygon in the base frame, shape (48, 2), m, at most ten times the
            depth away from the point below the camera.
    """
    border = _border(camera_size)
    out = np.empty_like(border)
    _footprint(camera, links[0], links[1], joint_angles[0], joint_angles[1], border, 10.0 * camera[4], out)
    return out


@njit(cache=True, nogil=True)
def _floor_lines(cam, l1, l2, theta1, theta2, spacing, size, points, lengths):  # type: ignore[no-untyped-def]
    phi = theta1 + theta2
    tx = l1 * math.cos(theta1) + l2 * math.cos(phi)
    ty = l1 * math.sin(theta1) + l2 * math.sin(phi)
    per_axis, samples = points.shape[0] // 2, points.shape[1]
    half = 0.5 * (per_axis - 1) * spacing
    center_x = round(tx / spacing) * spacing
    center_y = round(ty / spacing) * spacing
    for line in range(2 * per_axis):
        offset = (line % per_axis) * spacing - half
        lengths[line] = 0
        for j in range(samples):
            along = -half + 2.0 * half * j / (samples - 1)
            if line < per_axis:
                x, y = center_x + offset, center_y + along
            else:
                x, y = center_x + along, center_y + offset
            u, v, seen = project(cam, l1, l2, theta1, theta2, x, y)
            # A margin of one image keeps line segments that cross the border.
            if seen and -size < u < 2.0 * size and -size < v < 2.0 * size:
                points[line, lengths[line], 0] = u
                points[line, lengths[line], 1] = v
                lengths[line] += 1


def floor_lines(camera: Array, links: Array, joint_angles: Array, camera_size: int) -> list[Array]:
    """Grid lines of the floor around the tool in the camera's image.

    Args:
        camera: One packed camera, shape (CAMERA_SIZE,).
        links: Link lengths, shape (2,), m.
        joint_angles: Joint angles, shape (2,), rad.
        camera_size: Width and height of the image, px.

    Returns:
        Polylines of image points, each of shape (k, 2), px. Points may lie outside the image.
    """
    reach = min(max(1.5 * camera_size * camera[4] / camera[0], _LEAST_REACH), _LARGEST_REACH)
    spacing = GRID_SPACING if reach <= _SPARSE_REACH else 2.0 * GRID_SPACING
    per_axis = 2 * math.ceil(reach / spacing) + 1
    points = np.empty((2 * per_axis, _CURVED_POINTS if camera[16] else _STRAIGHT_POINTS, 2))
    lengths = np.empty(2 * per_axis, dtype=np.int64)
    (l1, l2), (theta1, theta2) = links, joint_angles
    _floor_lines(camera, l1, l2, theta1, theta2, spacing, camera_size, points, lengths)
    return [points[i, :k] for i, k in enumerate(lengths) if k > 1]
