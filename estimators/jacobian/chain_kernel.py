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
def _coefficients(square, full):  # type: ignore[no-untyped-def]
    """Return a = sin x / x, b = (1 - cos x) / x^2, c = (x - sin x) / x^3 of x^2, and b' / x and c' / x if `full`."""
    s = square
    along, across = 0.0, 0.0
    # Up to a quarter of a radian the series below are exact to rounding, and the closed forms lose digits.
    if s < 0.06:
        a = 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)))
        b = 0.5 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))))
        c = (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0)))) / 6.0
        if full:
            along = -(1.0 - s / 15.0 * (1.0 - s * 3.0 / 112.0 * (1.0 - s * 4.0 / 270.0))) / 12.0
            across = -(1.0 - s / 21.0 * (1.0 - s / 48.0 * (1.0 - s * 4.0 / 330.0))) / 60.0
        return a, b, c, along, across
    x = math.sqrt(s)
    sine, cosine = math.sin(x), math.cos(x)
    a, b, c = sine / x, (1.0 - cosine) / s, (x - sine) / (s * x)
    if full:
        along = (x * sine + 2.0 * cosine - 2.0) / (s * s)
        across = (3.0 * sine - x * cosine - 2.0 * x) / (s * s * x)
    return a, b, c, along, across


# Poses are tuples of rows, and motions tuples of components, which the compiler keeps in registers.


@njit(cache=True, nogil=True)
def joint_pose(parameters, at, angle):  # type: ignore[no-untyped-def]
    """Return the rows of the pose exp(twist angle) of the twist whose components begin at `at`."""
    x, y, z = parameters[at] * angle, parameters[at + 1] * angle, parameters[at + 2] * angle
    u, v, w = parameters[at + 3] * angle, parameters[at + 4] * angle, parameters[at + 5] * angle
    a, b, c, _, _ = _coefficients(x * x + y * y + z * z, False)
    # R = 1 + a [phi] + b [phi]^2, V = 1 + b [phi] + c [phi]^2.
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (
        (
            1.0 - b * (yy + zz),
            b * xy - a * z,
            b * xz + a * y,
            (1.0 - c * (yy + zz)) * u + (c * xy - b * z) * v + (c * xz + b * y) * w,
        ),
        (
            b * xy + a * z,
            1.0 - b * (xx + zz),
            b * yz - a * x,
            (c * xy + b * z) * u + (1.0 - c * (xx + zz)) * v + (c * yz - b * x) * w,
        ),
        (
            b * xz - a * y,
            b * yz + a * x,
            1.0 - b * (xx + yy),
            (c * xz - b * y) * u + (c * yz + b * x) * v + (1.0 - c * (xx + yy)) * w,
        ),
    )


@njit(cache=True, nogil=True)
def _joint(parameters, at, angle):  # type: ignore[no-untyped-def]
    """Return the rows of the pose exp(twist angle), and its derivatives.

    A change (dw, dv) of the twist multiplies the pose from the left by the small motion of angular velocity T dw angle
    and velocity (S dw + T dv) angle: the left Jacobian of SE(3) in closed form.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        at: Index of the first component of the twist (w, v) of the joint.
        angle: Joint angle, rad.

    Returns:
        Rows of the pose, columns of T and columns of S.
    """
    x, y, z = parameters[at] * angle, parameters[at + 1] * angle, parameters[at + 2] * angle
    u, v, w = parameters[at + 3] * angle, parameters[at + 4] * angle, parameters[at + 5] * angle
    a, b, c, b2, c2 = _coefficients(x * x + y * y + z * z, True)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    t00, t01, t02 = 1.0 - c * (yy + zz), c * xy - b * z, c * xz + b * y
    t10, t11, t12 = c * xy + b * z, 1.0 - c * (xx + zz), c * yz - b * x
    t20, t21, t22 = c * xz - b * y, c * yz + b * x, 1.0 - c * (xx + yy)
    pose = (
        (1.0 - b * (yy + zz), b * xy - a * z, b * xz + a * y, t00 * u + t01 * v + t02 * w),
        (b * xy + a * z, 1.0 - b * (xx + zz), b * yz - a * x, t10 * u + t11 * v + t12 * w),
        (b * xz - a * y, b * yz + a * x, 1.0 - b * (xx + yy), t20 * u + t21 * v + t22 * w),
    )
    # d (V rho) / d phi = -b [rho] - c ([phi x rho] + [phi] [rho]) + (b2 phi x rho + c2 phi x (phi x rho)) phi'.
    px, py, pz = y * w - z * v, z * u - x * w, x * v - y * u
    qx, qy, qz = y * pz - z * py, z * px - x * pz, x * py - y * px
    fx, fy, fz = b2 * px + c2 * qx, b2 * py + c2 * qy, b2 * pz + c2 * qz
    # [phi] [rho] = rho phi' - (phi . rho) 1.
    dot = x * u + y * v + z * w
    ex, ey, ez = b * u + c * px, b * v + c * py, b * w + c * pz
    first, second, third = (t00, t10, t20), (t01, t11, t21), (t02, t12, t22)
    # In the frame before the joint: minus the velocity that the rotation gives to the origin's image, + [t] V.
    shifts = (
        _carried(pose, first, ((fx - c * u) * x + c * dot, fy * x - c * v * x - ez, fz * x - c * w * x + ey)),
        _carried(pose, second, (fx * y - c * u * y + ez, (fy - c * v) * y + c * dot, fz * y - c * w * y - ex)),
        _carried(pose, third, (fx * z - c * u * z - ey, fy * z - c * v * z + ex, (fz - c * w) * z + c * dot)),
    )
    return pose, (first, second, third), shifts


@njit(cache=True, nogil=True)
def _carried(pose, turn, shift):  # type: ignore[no-untyped-def]
    """Return the velocity of a motion at the origin of the axes, of which `shift` is that at the pose's origin."""
    p, q, r = pose[0][3], pose[1][3], pose[2][3]
    a, b, c = turn
    return shift[0] + (q * c - r * b), shift[1] + (r * a - p * c), shift[2] + (p * b - q * a)


@njit(cache=True, nogil=True)
def _rotated(pose, vector):  # type: ignore[no-untyped-def]
    """Return a vector in the axes in which a pose is."""
    first, second, third = pose
    a, b, c = vector
    return (
        first[0] * a + first[1] * b + first[2] * c,
        second[0] * a + second[1] * b + second[2] * c,
        third[0] * a + third[1] * b + third[2] * c,
    )


@njit(cache=True, nogil=True)
def _product(pose, step):  # type: ignore[no-untyped-def]
    """Return the product of two poses."""
    return _row_product(pose[0], step), _row_product(pose[1], step), _row_product(pose[2], step)


@njit(cache=True, nogil=True)
def _row_product(row, step):  # type: ignore[no-untyped-def]
    a, b, c, d = row
    first, second, third = step
    return (
        a * first[0] + b * second[0] + c * third[0],
        a * first[1] + b * second[1] + c * third[1],
        a * first[2] + b * second[2] + c * third[2],
        d + (a * first[3] + b * second[3] + c * third[3]),
    )


@njit(cache=True, nogil=True)
def _origin():  # type: ignore[no-untyped-def]
    """Return the identical pose."""
    return (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)


@njit(cache=True, nogil=True)
def chain_pose(parameters, angles, reverse):  # type: ignore[no-untyped-def]
    """Return the rows of the pose that maps points at the origin of the angles to the camera's frame.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
    """
    n = angles.shape[0]
    pose = _origin()
    for at in range(n):
        k = n - 1 - at if reverse else at
        pose = _product(pose, joint_pose(parameters, 6 * k, angles[k]))
    return pose


@njit(cache=True, nogil=True)
def chain_features(parameters, angles, reverse, focal_unit, features):  # type: ignore[no-untyped-def]
    """Write the image points of a chain.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        focal_unit: Expected focal length f_0, px.
        features: Output, from the expected principal point c_0. Shape (2p,), px.
    """
    n, p = angles.shape[0], features.shape[0] // 2
    pose = chain_pose(parameters, angles, reverse)
    focal = focal_unit * math.exp(parameters[6 * n + 3 * p])
    for j in range(p):
        x, y, z = placed(pose, parameters, 6 * n + 3 * j)
        scale = focal / max(z, LEAST_DEPTH)
        features[2 * j] = scale * x + focal_unit * parameters[6 * n + 3 * p + 1]
        features[2 * j + 1] = scale * y + focal_unit * parameters[6 * n + 3 * p + 2]


@njit(cache=True, nogil=True)
def placed(pose, parameters, at):  # type: ignore[no-untyped-def]
    """Return the coordinates in the camera's frame of the point whose parameters begin at `at`."""
    a, b, c = parameters[at], parameters[at + 1], parameters[at + 2]
    first, second, third = pose
    return (
        first[0] * a + first[1] * b + first[2] * c + first[3],
        second[0] * a + second[1] * b + second[2] * c + second[3],
        third[0] * a + third[1] * b + third[2] * c + third[3],
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
    rates, motions = np.empty((6, n)), np.empty((6, 6 * n if full else 0))
    pose = chain_motions(parameters, angles, reverse, rates, motions)
    focal = focal_unit * math.exp(parameters[6 * n + 3 * p])
    rows, wrenches = np.empty((2, 6 * n + 6)), np.empty((2, 6))
    if full:
        by_parameters[:] = 0.0
    for j in range(p):
        x, y, z = placed(pose, parameters, 6 * n + 3 * j)
        for r in range(2):
            seen, gx, gy, gz = _projected(x, y, z, focal, r)
            row = 2 * j + r
            features[row] = seen + focal_unit * parameters[6 * n + 3 * p + 1 + r]
            # g . (w x P) = (P x g) . w.
            hx, hy, hz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
            for k in range(n):
                by_angles[row, k] = (
                    hx * rates[0, k]
                    + hy * rates[1, k]
                    + hz * rates[2, k]
                    + gx * rates[3, k]
                    + gy * rates[4, k]
                    + gz * rates[5, k]
                )
        if full:
            point_derivatives(pose, motions, (x, y, z), focal, focal_unit, rows, wrenches)
            for r in range(2):
                by_parameters[2 * j + r, : 6 * n] = rows[r, : 6 * n]
                by_parameters[2 * j + r, 6 * n + 3 * j : 6 * n + 3 * j + 3] = rows[r, 6 * n : 6 * n + 3]
                by_parameters[2 * j + r, 6 * n + 3 * p :] = rows[r, 6 * n + 3 :]


@njit(cache=True, nogil=True)
def jacobian_derivatives(parameters, angles, reverse, focal_unit, features, by_angles, columns):  # type: ignore[no-untyped-def]
    """Write the image points of a chain, their derivatives by the joint angles, and the derivatives of both.

    A parameter of a joint moves what follows it as a rigid body, the points and the fields of velocity of the joints
    behind them: V(P) turns with the body. In front of the joint and in itself, V changes as P does; its own field
    changes as its twist.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        focal_unit: See `chain_features`.
        features: Output. Shape (m,), px.
        by_angles: Output. Shape (m, n), px/rad.
        columns: Output: derivatives of `by_angles`, joint by joint, then of `features`, by each parameter. Shape (N,
            n m + m).
    """
    n, m = angles.shape[0], features.shape[0]
    twists, tail, own = 6 * n, parameters.shape[0] - 3, m * n
    rates, motions = np.empty((6, n)), np.empty((6, twists))
    pose = chain_motions(parameters, angles, reverse, rates, motions)
    fields = np.empty((6, twists))
    _own_fields(parameters, angles, reverse, fields)
    focal = focal_unit * math.exp(parameters[tail])
    columns[:] = 0.0
    speed = np.empty((n, 3))
    for j in range(m // 2):
        x, y, z = placed(pose, parameters, twists + 3 * j)
        # First and second derivatives of the projection.
        depth = max(z, LEAST_DEPTH)
        scale = focal / depth
        along = scale / depth if z > LEAST_DEPTH else 0.0
        steep = 2.0 * along / depth
        for k in range(n):
            speed[k, 0], speed[k, 1], speed[k, 2] = _velocity(rates, k, x, y, z)
        for r in range(2):
            i = 2 * j + r
            seen, gx, gy, gz = _projected(x, y, z, focal, r)
            features[i] = seen + focal_unit * parameters[tail + 1 + r]
            columns[tail, own + i], columns[tail + 1 + r, own + i] = seen, focal_unit
            for k in range(n):
                by_angles[i, k] = gx * speed[k, 0] + gy * speed[k, 1] + gz * speed[k, 2]
                # All that a camera shows is proportional to its focal length.
                columns[tail, k * m + i] = by_angles[i, k]
        for a in range(twists + 3):
            point = a - twists
            joint = a // 6
            if point < 0:
                dx, dy, dz = _velocity(motions, a, x, y, z)
                row = a
            else:
                dx, dy, dz = pose[0][point], pose[1][point], pose[2][point]
                row = twists + 3 * j + point
            first, second = (-along * dz, steep * x * dz - along * dx), (-along * dz, steep * y * dz - along * dy)
            columns[row, own + 2 * j] = scale * dx - along * x * dz
            columns[row, own + 2 * j + 1] = scale * dy - along * y * dz
            for k in range(n):
                u, v, w = speed[k, 0], speed[k, 1], speed[k, 2]
                behind = k < joint if reverse else k > joint
                if point < 0 and behind:
                    turn, arm = (motions[0, a], motions[1, a], motions[2, a]), (u, v, w)
                else:
                    turn, arm = (rates[0, k], rates[1, k], rates[2, k]), (dx, dy, dz)
                au = turn[1] * arm[2] - turn[2] * arm[1]
                av = turn[2] * arm[0] - turn[0] * arm[2]
                aw = turn[0] * arm[1] - turn[1] * arm[0]
                if point < 0 and k == joint:
                    fu, fv, fw = _velocity(fields, a, x, y, z)
                    au, av, aw = au + fu, av + fv, aw + fw
                columns[row, k * m + 2 * j] = first[0] * u + first[1] * w + scale * au - along * x * aw
                columns[row, k * m + 2 * j + 1] = second[0] * v + second[1] * w + scale * av - along * y * aw


@njit(cache=True, nogil=True)
def _own_fields(parameters, angles, reverse, fields):  # type: ignore[no-untyped-def]
    """Write the derivatives of each joint's motion by its angle, see `chain_motions`, by its twist. Shape (6, 6n)."""
    n = angles.shape[0]
    pose = _origin()
    for at in range(n):
        k = n - 1 - at if reverse else at
        for i in range(3):
            axis = (pose[0][i], pose[1][i], pose[2][i])
            _write_motion(fields, 6 * k + i, axis, _carried(pose, axis, (0.0, 0.0, 0.0)))
            _write_motion(fields, 6 * k + 3 + i, (0.0, 0.0, 0.0), axis)
        pose = _product(pose, joint_pose(parameters, 6 * k, angles[k]))


@njit(cache=True, nogil=True)
def _velocity(motions, column, x, y, z):  # type: ignore[no-untyped-def]
    """Return the velocity of a point in a motion, see `chain_motions`."""
    a, b, c = motions[0, column], motions[1, column], motions[2, column]
    u, v, w = motions[3, column], motions[4, column], motions[5, column]
    return b * z - c * y + u, c * x - a * z + v, a * y - b * x + w


@njit(cache=True, nogil=True)
def chain_motions(parameters, angles, reverse, rates, motions):  # type: ignore[no-untyped-def]
    """Write the motions of what follows each joint: angular velocity, and velocity of what is at the camera's center.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        angles: Joint angles. Shape (n,), rad.
        reverse: True if the last joint is next to the camera.
        rates: Output: motions by the joint angles. Shape (6, n), or (6, 0) to leave them out.
        motions: Output: motions by the components of the twists. Shape (6, 6n), or (6, 0) to leave them out.

    Returns:
        The pose of `chain_pose`.
    """
    n = angles.shape[0]
    pose = _origin()
    for at in range(n):
        k = n - 1 - at if reverse else at
        w, v = 6 * k, 6 * k + 3
        if rates.shape[1] > 0:
            turn = _rotated(pose, (parameters[w], parameters[w + 1], parameters[w + 2]))
            shift = _rotated(pose, (parameters[v], parameters[v + 1], parameters[v + 2]))
            _write_motion(rates, k, turn, _carried(pose, turn, shift))
        if motions.shape[1] == 0:
            pose = _product(pose, joint_pose(parameters, w, angles[k]))
            continue
        step, turns, shifts = _joint(parameters, w, angles[k])
        for j in range(3):
            turn = _scaled(angles[k], _rotated(pose, turns[j]))
            shift = _scaled(angles[k], _rotated(pose, shifts[j]))
            _write_motion(motions, w + j, turn, _carried(pose, turn, shift))
            _write_motion(motions, v + j, (0.0, 0.0, 0.0), turn)
        pose = _product(pose, step)
    return pose


@njit(cache=True, nogil=True)
def _scaled(factor, vector):  # type: ignore[no-untyped-def]
    return factor * vector[0], factor * vector[1], factor * vector[2]


@njit(cache=True, nogil=True)
def _write_motion(motions, column, turn, shift):  # type: ignore[no-untyped-def]
    motions[0, column], motions[1, column], motions[2, column] = turn
    motions[3, column], motions[4, column], motions[5, column] = shift


@njit(cache=True, nogil=True)
def point_derivatives(pose, motions, point, focal, focal_unit, rows, wrenches):  # type: ignore[no-untyped-def]
    """Write the derivatives of the image of one point by the parameters on which it depends.

    Args:
        pose: See `chain_pose`.
        motions: See `chain_motions`. Shape (6, 6n).
        point: Coordinates of the point in the camera's frame.
        focal: Focal length, px.
        focal_unit: See `chain_features`.
        rows: Output: derivatives by all twists, by the point, and by the last three parameters. Shape (2, 6n + 6).
        wrenches: Output: derivatives by the angular velocity and the velocity of a motion of the point. Shape (2, 6).
    """
    x, y, z = point
    twists = motions.shape[1]
    wx, wy, wz, vx, vy, vz = motions[0], motions[1], motions[2], motions[3], motions[4], motions[5]
    for r in range(2):
        seen, gx, gy, gz = _projected(x, y, z, focal, r)
        hx, hy, hz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        wrenches[r, 0], wrenches[r, 1], wrenches[r, 2] = hx, hy, hz
        wrenches[r, 3], wrenches[r, 4], wrenches[r, 5] = gx, gy, gz
        row = rows[r]
        for c in range(twists):
            row[c] = hx * wx[c] + hy * wy[c] + hz * wz[c] + gx * vx[c] + gy * vy[c] + gz * vz[c]
        for i in range(3):
            row[twists + i] = gx * pose[0][i] + gy * pose[1][i] + gz * pose[2][i]
        row[twists + 3] = seen
        row[twists + 4], row[twists + 5] = 0.0, 0.0
        row[twists + 4 + r] = focal_unit


@njit(cache=True, nogil=True)
def _projected(x, y, z, focal, r):  # type: ignore[no-untyped-def]
    """Return an image coordinate of a point, and the row that projects the point's velocity onto it."""
    depth = max(z, LEAST_DEPTH)
    scale = focal / depth
    along = scale / depth if z > LEAST_DEPTH else 0.0
    value = x if r == 0 else y
    return scale * value, scale if r == 0 else 0.0, scale if r == 1 else 0.0, -along * value


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
    for row in range(features.shape[0]):
        chain_features(parameters[row], angles[row], reverse[row], focal_unit[row], features[row])
