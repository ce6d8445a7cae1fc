"""Compiled mathematics of a rigid chain seen by a camera: image points and their derivatives.

A chain of n joints and p points has N = 6n + 3p + 3 parameters,

    [w_1 v_1 ... w_n v_n, X_1 ... X_p, log f / f_0, (c - c_0) / f_0]

in the frame of the camera where all angles are 0; lengths are in units of the points' mean depth. A point is then at
exp(xi_a q_a) ... exp(xi_z q_z) X in the camera's frame, with xi = (w, v) the twist of a joint (Lynch and Park, Modern
Robotics, 2017, eq. 4.14) and a, ..., z the joints from the camera to the points: in their order, or in reverse. Twists
are free: a joint that turns has |w| = 1 and w . v = 0 by the prior of the fit, one that slides has w = 0.
"""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Mask

LEAST_DEPTH = 0.05
"""Smallest depth in the projection, in mean depths: nearer points and points behind the camera count as this near."""


@njit(cache=True, nogil=True)
def _coefficients(square):  # type: ignore[no-untyped-def]
    """Return a = sin x / x, b = (1 - cos x) / x^2, c = (x - sin x) / x^3, b' / x and c' / x of x^2."""
    s = square
    # Up to a quarter of a radian the series below are exact to rounding, and the closed forms lose digits.
    if s < 0.06:
        return (
            1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0))),
            0.5 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0)))),
            (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0)))) / 6.0,
            -(1.0 - s / 15.0 * (1.0 - s * 3.0 / 112.0 * (1.0 - s * 4.0 / 270.0))) / 12.0,
            -(1.0 - s / 21.0 * (1.0 - s / 48.0 * (1.0 - s * 4.0 / 330.0))) / 60.0,
        )
    x = math.sqrt(s)
    sine, cosine = math.sin(x), math.cos(x)
    return (
        sine / x,
        (1.0 - cosine) / s,
        (x - sine) / (s * x),
        (x * sine + 2.0 * cosine - 2.0) / (s * s),
        (3.0 * sine - x * cosine - 2.0 * x) / (s * s * x),
    )


@njit(cache=True, nogil=True)
def _joint(twist, angle, pose, turn, shift):  # type: ignore[no-untyped-def]
    """Write the pose exp(twist angle) and its derivatives.

    A change (dw, dv) of the twist multiplies the pose from the left by the small motion of angular velocity
    `turn` dw angle and velocity (`shift` dw + `turn` dv) angle: the left Jacobian of SE(3) in closed form.

    Args:
        twist: Twist (w, v) of the joint. Shape (6,).
        angle: Joint angle, rad.
        pose: Output. Shape (3, 4).
        turn: Output. Shape (3, 3).
        shift: Output. Shape (3, 3).
    """
    x, y, z = twist[0] * angle, twist[1] * angle, twist[2] * angle
    u, v, w = twist[3] * angle, twist[4] * angle, twist[5] * angle
    a, b, c, b2, c2 = _coefficients(x * x + y * y + z * z)
    # R = 1 + a [phi] + b [phi]^2, V = 1 + b [phi] + c [phi]^2.
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    pose[0, 0], pose[0, 1], pose[0, 2] = 1.0 - b * (yy + zz), b * xy - a * z, b * xz + a * y
    pose[1, 0], pose[1, 1], pose[1, 2] = b * xy + a * z, 1.0 - b * (xx + zz), b * yz - a * x
    pose[2, 0], pose[2, 1], pose[2, 2] = b * xz - a * y, b * yz + a * x, 1.0 - b * (xx + yy)
    turn[0, 0], turn[0, 1], turn[0, 2] = 1.0 - c * (yy + zz), c * xy - b * z, c * xz + b * y
    turn[1, 0], turn[1, 1], turn[1, 2] = c * xy + b * z, 1.0 - c * (xx + zz), c * yz - b * x
    turn[2, 0], turn[2, 1], turn[2, 2] = c * xz - b * y, c * yz + b * x, 1.0 - c * (xx + yy)
    for i in range(3):
        pose[i, 3] = turn[i, 0] * u + turn[i, 1] * v + turn[i, 2] * w
    # d (V rho) / d phi = -b [rho] - c ([phi x rho] + [phi] [rho]) + (b2 phi x rho + c2 phi x (phi x rho)) phi'.
    px, py, pz = y * w - z * v, z * u - x * w, x * v - y * u
    qx, qy, qz = y * pz - z * py, z * px - x * pz, x * py - y * px
    fx, fy, fz = b2 * px + c2 * qx, b2 * py + c2 * qy, b2 * pz + c2 * qz
    # [phi] [rho] = rho phi' - (phi . rho) 1.
    dot = x * u + y * v + z * w
    ex, ey, ez = b * u + c * px, b * v + c * py, b * w + c * pz
    shift[0, 0], shift[0, 1], shift[0, 2] = (
        (fx - c * u) * x + c * dot,
        (fx) * y - c * u * y + ez,
        fx * z - c * u * z - ey,
    )
    shift[1, 0], shift[1, 1], shift[1, 2] = fy * x - c * v * x - ez, (fy - c * v) * y + c * dot, fy * z - c * v * z + ex
    shift[2, 0], shift[2, 1], shift[2, 2] = fz * x - c * w * x + ey, fz * y - c * w * y - ex, (fz - c * w) * z + c * dot
    # In the frame before the joint: minus the velocity that the rotation gives to the origin's image, + [t] V.
    for j in range(3):
        s0, s1, s2 = turn[0, j], turn[1, j], turn[2, j]
        shift[0, j] += pose[1, 3] * s2 - pose[2, 3] * s1
        shift[1, j] += pose[2, 3] * s0 - pose[0, 3] * s2
        shift[2, j] += pose[0, 3] * s1 - pose[1, 3] * s0


@njit(cache=True, nogil=True)
def chain_pose(parameters, angles, reverse, pose, scratch):  # type: ignore[no-untyped-def]
    """Write the pose that maps points at the origin of the angles to the camera's frame.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        pose: Output. Shape (3, 4).
        scratch: Shape (4, 3, 4).
    """
    n = angles.shape[0]
    step, turn, shift = scratch[0], scratch[1][:, :3], scratch[2][:, :3]
    for i in range(3):
        for j in range(4):
            pose[i, j] = 1.0 if i == j else 0.0
    for at in range(n):
        k = n - 1 - at if reverse else at
        _joint(parameters[6 * k : 6 * k + 6], angles[k], step, turn, shift)
        _append(pose, step)


@njit(cache=True, nogil=True)
def _append(pose, step):  # type: ignore[no-untyped-def]
    """Multiply a pose by another one from the right, in place."""
    for i in range(3):
        a, b, c = pose[i, 0], pose[i, 1], pose[i, 2]
        for j in range(3):
            pose[i, j] = a * step[0, j] + b * step[1, j] + c * step[2, j]
        pose[i, 3] += a * step[0, 3] + b * step[1, 3] + c * step[2, 3]


@njit(cache=True, nogil=True)
def chain_features(parameters, angles, reverse, focal_unit, features, scratch):  # type: ignore[no-untyped-def]
    """Write the image points of a chain.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        focal_unit: Expected focal length f_0, px.
        features: Output, from the expected principal point c_0. Shape (2p,), px.
        scratch: Shape (4, 3, 4).
    """
    n, p = angles.shape[0], features.shape[0] // 2
    pose = scratch[3]
    chain_pose(parameters, angles, reverse, pose, scratch)
    focal = focal_unit * math.exp(parameters[6 * n + 3 * p])
    for j in range(p):
        x, y, z = _placed(pose, parameters, 6 * n + 3 * j)
        scale = focal / max(z, LEAST_DEPTH)
        features[2 * j] = scale * x + focal_unit * parameters[6 * n + 3 * p + 1]
        features[2 * j + 1] = scale * y + focal_unit * parameters[6 * n + 3 * p + 2]


@njit(cache=True, nogil=True)
def _placed(pose, parameters, at):  # type: ignore[no-untyped-def]
    """Return the coordinates in the camera's frame of the point whose parameters begin at `at`."""
    a, b, c = parameters[at], parameters[at + 1], parameters[at + 2]
    return (
        pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3],
        pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3],
        pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3],
    )


@njit(cache=True, nogil=True)
def chain_derivatives(  # type: ignore[no-untyped-def]
    parameters, angles, reverse, focal_unit, features, by_angles, by_parameters
):
    """Write the image points of a chain and their derivatives.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        focal_unit: See `chain_features`.
        features: Output. Shape (2p,), px.
        by_angles: Output: derivatives by the joint angles. Shape (2p, n), px/rad.
        by_parameters: Output: derivatives by the parameters. Shape (2p, N), or (0, N) to leave them out.
    """
    n, p = angles.shape[0], features.shape[0] // 2
    full = by_parameters.shape[0] > 0
    step, pose = np.empty((3, 4)), np.zeros((3, 4))
    turn, shift = np.empty((3, 3)), np.empty((3, 3))
    rate, by_turn, by_shift = np.empty((n, 6)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for i in range(3):
        pose[i, i] = 1.0
    for at in range(n):
        k = n - 1 - at if reverse else at
        twist = parameters[6 * k : 6 * k + 6]
        _joint(twist, angles[k], step, turn, shift)
        # All motions in the camera's frame: angular velocity w, and velocity of what is at the camera's center.
        for i in range(3):
            rate[k, i] = pose[i, 0] * twist[0] + pose[i, 1] * twist[1] + pose[i, 2] * twist[2]
            rate[k, 3 + i] = pose[i, 0] * twist[3] + pose[i, 1] * twist[4] + pose[i, 2] * twist[5]
        _carry(pose, rate[k])
        if full:
            for j in range(3):
                for i in range(3):
                    by_turn[k, i, j] = angles[k] * (
                        pose[i, 0] * turn[0, j] + pose[i, 1] * turn[1, j] + pose[i, 2] * turn[2, j]
                    )
                    by_shift[k, i, j] = angles[k] * (
                        pose[i, 0] * shift[0, j] + pose[i, 1] * shift[1, j] + pose[i, 2] * shift[2, j]
                    )
                a, b, c = by_turn[k, 0, j], by_turn[k, 1, j], by_turn[k, 2, j]
                by_shift[k, 0, j] += pose[1, 3] * c - pose[2, 3] * b
                by_shift[k, 1, j] += pose[2, 3] * a - pose[0, 3] * c
                by_shift[k, 2, j] += pose[0, 3] * b - pose[1, 3] * a
        _append(pose, step)
    focal = focal_unit * math.exp(parameters[6 * n + 3 * p])
    if full:
        by_parameters[:] = 0.0
    for j in range(p):
        x, y, z = _placed(pose, parameters, 6 * n + 3 * j)
        depth = max(z, LEAST_DEPTH)
        scale = focal / depth
        along = scale / depth if z > LEAST_DEPTH else 0.0
        for r in range(2):
            # The row (gx, gy, gz) projects a velocity of the point.
            gx, gy = (scale, 0.0) if r == 0 else (0.0, scale)
            gz = -along * (x if r == 0 else y)
            row = 2 * j + r
            seen = scale * (x if r == 0 else y)
            features[row] = seen + focal_unit * parameters[6 * n + 3 * p + 1 + r]
            # g . (w x P) = (P x g) . w.
            hx, hy, hz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
            for k in range(n):
                by_angles[row, k] = (
                    hx * rate[k, 0]
                    + hy * rate[k, 1]
                    + hz * rate[k, 2]
                    + gx * rate[k, 3]
                    + gy * rate[k, 4]
                    + gz * rate[k, 5]
                )
            if not full:
                continue
            for k in range(n):
                for i in range(3):
                    by_parameters[row, 6 * k + i] = (
                        hx * by_turn[k, 0, i]
                        + hy * by_turn[k, 1, i]
                        + hz * by_turn[k, 2, i]
                        + gx * by_shift[k, 0, i]
                        + gy * by_shift[k, 1, i]
                        + gz * by_shift[k, 2, i]
                    )
                    by_parameters[row, 6 * k + 3 + i] = (
                        gx * by_turn[k, 0, i] + gy * by_turn[k, 1, i] + gz * by_turn[k, 2, i]
                    )
            for i in range(3):
                by_parameters[row, 6 * n + 3 * j + i] = gx * pose[0, i] + gy * pose[1, i] + gz * pose[2, i]
            by_parameters[row, 6 * n + 3 * p] = seen
            by_parameters[row, 6 * n + 3 * p + 1 + r] = focal_unit


@njit(cache=True, nogil=True)
def _carry(pose, rate):  # type: ignore[no-untyped-def]
    """Change the point of reference of a motion, whose axes are those of the camera, to the camera's center."""
    a, b, c = rate[0], rate[1], rate[2]
    rate[3] += pose[1, 3] * c - pose[2, 3] * b
    rate[4] += pose[2, 3] * a - pose[0, 3] * c
    rate[5] += pose[0, 3] * b - pose[1, 3] * a


def chain_feature_rows(parameters: Array, angles: Array, reverse: Mask, focal_unit: Array, points: int) -> Array:
    """Return the image points of chains, shape (*batch, 2p), px. Arguments as in `chain_features`, with batch axes."""
    batch, n = angles.shape[:-1], angles.shape[-1]
    out = np.zeros((*batch, 2 * points))
    rows = out.reshape(-1, 2 * points)
    _feature_rows(
        parameters.reshape(-1, parameters.shape[-1]),
        np.ascontiguousarray(angles.reshape(-1, n)),
        reverse.reshape(-1),
        focal_unit.reshape(-1),
        rows,
    )
    return out


@njit(cache=True, nogil=True)
def _feature_rows(parameters, angles, reverse, focal_unit, features):  # type: ignore[no-untyped-def]
    scratch = np.zeros((4, 3, 4))
    for row in range(features.shape[0]):
        chain_features(parameters[row], angles[row], reverse[row], focal_unit[row], features[row], scratch)
