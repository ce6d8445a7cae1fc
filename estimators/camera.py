"""Camera model on a planar two-link arm, looking down on the plane of its targets (Zhang 2011, section 3.1).

The camera is at the tool, `depth` above the plane. Its x axis is the direction of the second link rotated by the
mounting angle psi; y and z are flipped. With phi = theta1 + theta2 + psi a ground point p appears, before tilt, at

    q = (F R(phi)^T (p - p_tool), depth),  F = diag(1, -1).

A small rotation Rx(tilt_x) Ry(tilt_y) tilts the optical axis. The pinhole projection has the focal lengths (f, f (1 +
aspect)) and the radial distortion d (1 + k1 |d|^2 / half_width^2) of the pixel offset d from the principal point. With
k1 < 0 the image folds over where 1 + 3 k1 rho^2 <= 0; points beyond the fold are never visible.

The scalar kernels are compiled, so that one arm and a batch of arms get the same bits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Mask

CAMERA_SIZE = 18
"""Columns of a packed camera: fx, fy, cu, cv, depth, cos psi, sin psi, tilt rotation (9), k1, 1/half_width."""


def pack_camera(
    focal: ArrayLike,
    depth: ArrayLike,
    mounting: ArrayLike = 0.0,
    center: ArrayLike = (240.0, 240.0),
    tilt: ArrayLike = (0.0, 0.0),
    aspect: ArrayLike = 0.0,
    distortion: ArrayLike = 0.0,
    half_width: float = 240.0,
) -> Array:
    """Pack camera parameters into rows for the kernels.

    Args:
        focal: Focal length f in pixels. Shape (*batch,), px.
        depth: Height of the camera above the plane. Shape (*batch,), m.
        mounting: Angle psi between the camera's x axis and the second link. Shape (*batch,), rad.
        center: Principal point. Shape (*batch, 2), px.
        tilt: Rotations about the camera's x and y axes. Shape (*batch, 2), rad.
        aspect: Excess of the vertical over the horizontal focal length, as a fraction. Shape (*batch,).
        distortion: Radial coefficient k1 at one half width from the principal point. Shape (*batch,).
        half_width: Half the image width, px; the unit of the radius in the distortion.

    Returns:
        Packed cameras. Shape (*batch, CAMERA_SIZE).
    """
    single = [np.asarray(a, dtype=np.float64)[..., None] for a in (focal, depth, mounting, aspect, distortion)]
    batch, rows = _rows(*np.broadcast_arrays(*single), center, tilt)
    packed = np.zeros((len(rows[0]), CAMERA_SIZE))
    _pack_rows(*rows, half_width, packed)
    return packed.reshape(*batch, CAMERA_SIZE)


@njit(cache=True, nogil=True)
def pack_into(focal, depth, mounting, cu, cv, tilt_x, tilt_y, aspect, distortion, half_width, out):  # type: ignore[no-untyped-def]
    """Write one packed camera to `out` (CAMERA_SIZE,). Arguments: see `pack_camera`."""
    cx, sx, cy, sy = math.cos(tilt_x), math.sin(tilt_x), math.cos(tilt_y), math.sin(tilt_y)
    out[0], out[1], out[2], out[3], out[4] = focal, focal * (1.0 + aspect), cu, cv, depth
    out[5], out[6] = math.cos(mounting), math.sin(mounting)
    out[7], out[8], out[9] = cy, 0.0, sy
    out[10], out[11], out[12] = sx * sy, cx, -sx * cy
    out[13], out[14], out[15] = -cx * sy, sx, cx * cy
    out[16], out[17] = distortion, 1.0 / half_width


@njit(cache=True, nogil=True)
def _pack_rows(focal, depth, mounting, aspect, distortion, center, tilt, half_width, out):  # type: ignore[no-untyped-def]
    for i in range(out.shape[0]):
        pack_into(
            focal[i, 0], depth[i, 0], mounting[i, 0], center[i, 0], center[i, 1], tilt[i, 0], tilt[i, 1], aspect[i, 0],
            distortion[i, 0], half_width, out[i],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def project_ground(cam, gx, gy):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of a ground point in the untilted camera frame; True if it lies in front and before the fold.

    Args:
        cam: One packed camera, shape (CAMERA_SIZE,).
        gx: First coordinate of F R(phi)^T (p - p_tool), m.
        gy: Second coordinate, m.
    """
    d = cam[4]
    qx = cam[7] * gx + cam[8] * gy + cam[9] * d
    qy = cam[10] * gx + cam[11] * gy + cam[12] * d
    qz = cam[13] * gx + cam[14] * gy + cam[15] * d
    if qz < 1e-6 * d:
        return cam[2], cam[3], False
    du = cam[0] * qx / qz
    dv = cam[1] * qy / qz
    rho2 = (du * du + dv * dv) * cam[17] * cam[17]
    k = cam[16]
    stretch = 1.0 + k * rho2
    return cam[2] + du * stretch, cam[3] + dv * stretch, 1.0 + 3.0 * k * rho2 > 0.0


@njit(cache=True, nogil=True)
def zoom_into(cam, goal, factor, out):  # type: ignore[no-untyped-def]
    """Write a packed camera to `out` (CAMERA_SIZE,) that magnifies `factor` times as much about the pixel `goal`.

    Args:
        cam: The packed camera, shape (CAMERA_SIZE,).
        goal: Image of the point under the tool, shape (2,), px. It stays where it is.
        factor: New focal length over the old one.
        out: The new packed camera, shape (CAMERA_SIZE,).
    """
    out[:] = cam
    out[0], out[1] = factor * cam[0], factor * cam[1]
    u, v, _ = project_ground(out, 0.0, 0.0)
    out[2], out[3] = cam[2] + goal[0] - u, cam[3] + goal[1] - v


@njit(cache=True, nogil=True)
def _zoom_rows(cameras, goals, factors, out):  # type: ignore[no-untyped-def]
    for i in range(out.shape[0]):
        zoom_into(cameras[i], goals[i], factors[i], out[i])


def zoomed_cameras(cameras: ArrayLike, goals: ArrayLike, factors: ArrayLike) -> Array:
    """Return packed cameras that magnify by factors about their goals, which stay where they are in the image.

    Args:
        cameras: Packed cameras. Shape (*batch, CAMERA_SIZE).
        goals: Images of the points under the tools. Shape (*batch, 2), px.
        factors: New focal length over the old one. Shape (*batch,).

    Returns:
        Packed cameras. Shape (*batch, CAMERA_SIZE).
    """
    batch, rows = _rows(cameras, goals, np.asarray(factors, dtype=np.float64)[..., None])
    out = np.zeros((len(rows[0]), CAMERA_SIZE))
    _zoom_rows(rows[0], rows[1], rows[2][:, 0], out)
    return out.reshape(*batch, CAMERA_SIZE)


@njit(cache=True, nogil=True)
def project(cam, l1, l2, theta1, theta2, px, py):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of the ground point (px, py) m seen from the arm's tool, and True if it is projectable."""
    phi = theta1 + theta2
    c2, s2 = math.cos(phi), math.sin(phi)
    wx = px - l1 * math.cos(theta1) - l2 * c2
    wy = py - l1 * math.sin(theta1) - l2 * s2
    c = c2 * cam[5] - s2 * cam[6]
    s = s2 * cam[5] + c2 * cam[6]
    return project_ground(cam, c * wx + s * wy, s * wx - c * wy)


@njit(cache=True, nogil=True)
def total_jacobian(cam, l1, l2, theta1, theta2, px, py, vx, vy, out):  # type: ignore[no-untyped-def]
    """Write the total image Jacobian [J_theta J_t] of the ground point (px, py) moving at (vx, vy) to `out` (2, 3)."""
    phi = theta1 + theta2
    c1, s1 = math.cos(theta1), math.sin(theta1)
    c2, s2 = math.cos(phi), math.sin(phi)
    wx = px - l1 * c1 - l2 * c2
    wy = py - l1 * s1 - l2 * s2
    c = c2 * cam[5] - s2 * cam[6]
    s = s2 * cam[5] + c2 * cam[6]
    gx = c * wx + s * wy
    gy = s * wx - c * wy
    d = cam[4]
    qx = cam[7] * gx + cam[8] * gy + cam[9] * d
    qy = cam[10] * gx + cam[11] * gy + cam[12] * d
    qz = max(cam[13] * gx + cam[14] * gy + cam[15] * d, 1e-6 * d)
    du = cam[0] * qx / qz
    dv = cam[1] * qy / qz
    k = cam[16] * cam[17] * cam[17]
    stretch = 1.0 + k * (du * du + dv * dv)
    for j in range(3):
        # Derivative of w = p - p_tool by joint 1, joint 2 and time, and of the frame angle phi by the joints.
        if j == 0:
            ax, ay, turn = l1 * s1 + l2 * s2, -l1 * c1 - l2 * c2, 1.0
        elif j == 1:
            ax, ay, turn = l2 * s2, -l2 * c2, 1.0
        else:
            ax, ay, turn = vx, vy, 0.0
        dgx = c * ax + s * ay - turn * gy
        dgy = s * ax - c * ay + turn * gx
        dqx = cam[7] * dgx + cam[8] * dgy
        dqy = cam[10] * dgx + cam[11] * dgy
        dqz = cam[13] * dgx + cam[14] * dgy
        ddu = (cam[0] * dqx - du * dqz) / qz
        ddv = (cam[1] * dqy - dv * dqz) / qz
        radial = 2.0 * k * (du * ddu + dv * ddv)
        out[0, j] = ddu * stretch + du * radial
        out[1, j] = ddv * stretch + dv * radial


@njit(cache=True, nogil=True)
def ground_point(cam, u, v):  # type: ignore[no-untyped-def]
    """Ground point (gx, gy) m of pixel (u, v) in the untilted camera frame: the inverse of `project_ground`.

    Pixels beyond the fold or above the horizon give a far point in their direction.
    """
    du, dv = u - cam[2], v - cam[3]
    rho_d = math.hypot(du, dv) * cam[17]
    k = cam[16]
    rho = rho_d
    if k < 0.0:
        rho_fold = math.sqrt(-1.0 / (3.0 * k))
        rho = min(rho, 0.999 * rho_fold)
    for _ in range(8):
        slope = 1.0 + 3.0 * k * rho * rho
        step = (rho * (1.0 + k * rho * rho) - rho_d) / slope
        # Converged to the bit; without distortion in the first iteration.
        if step == 0.0:
            break
        rho = rho - step
        if k < 0.0 and rho > 0.999 * rho_fold:
            rho = 0.999 * rho_fold
    scale = rho / rho_d if rho_d > 1e-12 else 1.0
    x = du * scale / cam[0]
    y = dv * scale / cam[1]
    # The transposed tilt rotation gives the ray in the untilted frame.
    rx = cam[7] * x + cam[10] * y + cam[13]
    ry = cam[8] * x + cam[11] * y + cam[14]
    rz = max(cam[9] * x + cam[12] * y + cam[15], 1e-3)
    return rx * cam[4] / rz, ry * cam[4] / rz


@njit(cache=True, nogil=True)
def _project_rows(cam, links, joints, points, out, seen):  # type: ignore[no-untyped-def]
    for i in range(cam.shape[0]):
        u, v, ok = project(cam[i], links[i, 0], links[i, 1], joints[i, 0], joints[i, 1], points[i, 0], points[i, 1])
        out[i, 0] = u
        out[i, 1] = v
        seen[i] = ok


@njit(cache=True, nogil=True)
def _jacobian_rows(cam, links, joints, points, velocities, out):  # type: ignore[no-untyped-def]
    for i in range(cam.shape[0]):
        total_jacobian(
            cam[i], links[i, 0], links[i, 1], joints[i, 0], joints[i, 1],
            points[i, 0], points[i, 1], velocities[i, 0], velocities[i, 1], out[i],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _ground_rows(cam, pixels, out):  # type: ignore[no-untyped-def]
    for i in range(cam.shape[0]):
        out[i, 0], out[i, 1] = ground_point(cam[i], pixels[i, 0], pixels[i, 1])


def _rows(*arrays: ArrayLike) -> tuple[tuple[int, ...], list[Array]]:
    """Return the common batch shape of arrays of row vectors, and each array as contiguous (rows, columns)."""
    values = [np.asarray(a, dtype=np.float64) for a in arrays]
    batch = np.broadcast_shapes(*(a.shape[:-1] for a in values))
    return batch, [
        np.ascontiguousarray(np.broadcast_to(a, (*batch, a.shape[-1]))).reshape(-1, a.shape[-1]) for a in values
    ]


def project_points(
    camera: ArrayLike, links: ArrayLike, joint_angles: ArrayLike, points: ArrayLike
) -> tuple[Array, Mask]:
    """Project ground points into the image.

    Args:
        camera: Packed cameras (`pack_camera`). Shape (*batch, CAMERA_SIZE).
        links: Link lengths. Shape (*batch, 2), m.
        joint_angles: Joint angles. Shape (*batch, 2), rad.
        points: Ground points in the base frame. Shape (*batch, 2), m.

    Returns:
        Pixels, shape (*batch, 2), and a mask of the points in front of the camera and before the fold, shape
        (*batch,). The image borders are ignored.
    """
    batch, (cam, link, joint, point) = _rows(camera, links, joint_angles, points)
    out, seen = np.empty((len(cam), 2)), np.empty(len(cam), dtype=np.bool_)
    _project_rows(cam, link, joint, point, out, seen)
    return out.reshape(*batch, 2), seen.reshape(batch)


def image_jacobian(
    camera: ArrayLike, links: ArrayLike, joint_angles: ArrayLike, points: ArrayLike, velocities: ArrayLike
) -> Array:
    """Analytic total image Jacobian [J_theta J_t] of moving ground points (Zhang 2011, eqs 3 to 6).

    Args:
        camera: Packed cameras. Shape (*batch, CAMERA_SIZE).
        links: Link lengths. Shape (*batch, 2), m.
        joint_angles: Joint angles. Shape (*batch, 2), rad.
        points: Ground points in the base frame. Shape (*batch, 2), m.
        velocities: Velocities of the ground points. Shape (*batch, 2), m/s.

    Returns:
        Jacobians. Shape (*batch, 2, 3): px/rad, px/rad, px/s.
    """
    batch, (cam, link, joint, point, velocity) = _rows(camera, links, joint_angles, points, velocities)
    out = np.empty((len(cam), 2, 3))
    _jacobian_rows(cam, link, joint, point, velocity, out)
    return out.reshape(*batch, 2, 3)


def ground_points(camera: ArrayLike, pixels: ArrayLike) -> Array:
    """Ground points of pixels in the untilted camera frame: F R(phi)^T (p - p_tool).

    Args:
        camera: Packed cameras (`pack_camera`). Shape (*batch, CAMERA_SIZE).
        pixels: Pixels (u, v). Shape (*batch, 2), px.

    Returns:
        Ground points. Shape (*batch, 2), m.
    """
    batch, (cam, pixel) = _rows(camera, pixels)
    out = np.empty((len(cam), 2))
    _ground_rows(cam, pixel, out)
    return out.reshape(*batch, 2)
