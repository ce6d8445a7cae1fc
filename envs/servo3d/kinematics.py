"""Compiled kinematics of serial arms: poses by the product of exponentials, image points, and their derivatives.

Poses are arrays of shape (3, 4), rotation and translation, that map coordinates of a frame to the base. Sources: Lynch
and Park, Modern Robotics, 2017, eq. 4.14 (poses) and 5.11 (columns of the Jacobian).
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

LEAST_DEPTH = 0.01
"""Smallest distance of a visible point in front of the camera, m."""
GRAVITY = 9.81
"""Acceleration of gravity, m/s^2."""
_ITERATIONS = 12
_DAMPING = 1e-4  # of the normal equations of `approach_pose`, m^2


class ArmTables(NamedTuple):
    """An arm for the compiled kernels, see `SerialArm`.

    Attributes:
        axes: Directions of the axes. Shape (n, 3).
        points: Points of the axes. Shape (n, 3), m.
        tool: Pose of the tool at zero angles. Shape (4, 4), m.
        low: Lower joint limits. Shape (n,), rad.
        high: Upper joint limits. Shape (n,), rad.
        masses: Masses of the links. Shape (n,), kg.
    """

    axes: Array
    points: Array
    tool: Array
    low: Array
    high: Array
    masses: Array


@njit(cache=True, nogil=True)
def turn_about(pose, axes, points, joint, angle):  # type: ignore[no-untyped-def]
    """Multiply a pose by the rotation about the line of a joint, in place: pose <- pose exp([screw] angle)."""
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    x, y, z = axes[joint, 0], axes[joint, 1], axes[joint, 2]
    r00, r01, r02 = c + d * x * x, d * x * y - s * z, d * x * z + s * y
    r10, r11, r12 = d * x * y + s * z, c + d * y * y, d * y * z - s * x
    r20, r21, r22 = d * x * z - s * y, d * y * z + s * x, c + d * z * z
    px, py, pz = points[joint, 0], points[joint, 1], points[joint, 2]
    tx = px - (r00 * px + r01 * py + r02 * pz)
    ty = py - (r10 * px + r11 * py + r12 * pz)
    tz = pz - (r20 * px + r21 * py + r22 * pz)
    for i in range(3):
        a, b, e = pose[i, 0], pose[i, 1], pose[i, 2]
        pose[i, 3] += a * tx + b * ty + e * tz
        pose[i, 0] = a * r00 + b * r10 + e * r20
        pose[i, 1] = a * r01 + b * r11 + e * r21
        pose[i, 2] = a * r02 + b * r12 + e * r22


@njit(cache=True, nogil=True)
def compose(first, second, out):  # type: ignore[no-untyped-def]
    """Set `out` to the product of two poses; `out` must be another array."""
    for i in range(3):
        a, b, c = first[i, 0], first[i, 1], first[i, 2]
        for j in range(4):
            out[i, j] = a * second[0, j] + b * second[1, j] + c * second[2, j]
        out[i, 3] += first[i, 3]


@njit(cache=True, nogil=True)
def tool_pose(axes, points, tool, angles, row, chain, out):  # type: ignore[no-untyped-def]
    """Set `out` to the pose of the tool.

    Args:
        axes: See `ArmTables`. Kernels that run for each row take arrays one by one: tuples of arrays cost more than
            the computation.
        points: See `ArmTables`.
        tool: See `ArmTables`.
        angles: Joint angles. Shape (N, n), rad.
        row: Row of `angles`.
        chain: Scratch, a pose.
        out: The result, a pose.
    """
    _identity(chain)
    for j in range(angles.shape[1]):
        turn_about(chain, axes, points, j, angles[row, j])
    compose(chain, tool, out)


@njit(cache=True, nogil=True)
def axes_now(axes, points, tool, angles, row, chain, lines, out):  # type: ignore[no-untyped-def]
    """Write the present directions and points of the joints' axes into `lines`, shape (n, 6), and the tool's pose.

    Args:
        axes: See `ArmTables`.
        points: See `ArmTables`.
        tool: See `ArmTables`.
        angles: Joint angles. Shape (N, n), rad.
        row: Row of `angles`.
        chain: Scratch, a pose.
        lines: Output. Shape (n, 6), m.
        out: Output, a pose.
    """
    _identity(chain)
    for j in range(angles.shape[1]):
        for i in range(3):
            a, b, c = chain[i, 0], chain[i, 1], chain[i, 2]
            lines[j, i] = a * axes[j, 0] + b * axes[j, 1] + c * axes[j, 2]
            lines[j, 3 + i] = a * points[j, 0] + b * points[j, 1] + c * points[j, 2] + chain[i, 3]
        turn_about(chain, axes, points, j, angles[row, j])
    compose(chain, tool, out)


@njit(cache=True, nogil=True)
def _identity(pose):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(4):
            pose[i, j] = 1.0 if i == j else 0.0


@njit(cache=True, nogil=True)
def take(poses, row, out):  # type: ignore[no-untyped-def]
    """Copy one of several poses into `out`. Shapes (N, 3, 4) and (3, 4)."""
    for i in range(3):
        for j in range(4):
            out[i, j] = poses[row, i, j]


@njit(cache=True, nogil=True)
def divide(first, second, out):  # type: ignore[no-untyped-def]
    """Set `out` to the product of a pose and the inverse of another: the frame in which `first` is `second`."""
    for i in range(3):
        for j in range(3):
            out[i, j] = first[i, 0] * second[j, 0] + first[i, 1] * second[j, 1] + first[i, 2] * second[j, 2]
        out[i, 3] = first[i, 3] - (out[i, 0] * second[0, 3] + out[i, 1] * second[1, 3] + out[i, 2] * second[2, 3])


@njit(cache=True, nogil=True)
def relative(first, second, out):  # type: ignore[no-untyped-def]
    """Set `out` to the product of the inverse of a pose and another: `second` in the frame of `first`."""
    for i in range(3):
        a, b, c = first[0, i], first[1, i], first[2, i]
        for j in range(3):
            out[i, j] = a * second[0, j] + b * second[1, j] + c * second[2, j]
        x, y, z = second[0, 3] - first[0, 3], second[1, 3] - first[1, 3], second[2, 3] - first[2, 3]
        out[i, 3] = a * x + b * y + c * z


@njit(cache=True, nogil=True)
def inverse(pose, out):  # type: ignore[no-untyped-def]
    """Set `out` to the inverse of a pose; `out` must be another array."""
    for i in range(3):
        for j in range(3):
            out[i, j] = pose[j, i]
        out[i, 3] = -(pose[0, i] * pose[0, 3] + pose[1, i] * pose[1, 3] + pose[2, i] * pose[2, 3])


@njit(cache=True, nogil=True)
def rows_of(pose):  # type: ignore[no-untyped-def]
    """Return the entries of a pose as three tuples, which the compiler keeps in registers."""
    return (
        (pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]),
        (pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]),
        (pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]),
    )


@njit(cache=True, nogil=True)
def moved(rows, x, y, z):  # type: ignore[no-untyped-def]
    """Return the coordinates of a point after a change of frame.

    Args:
        rows: Pose of the point's frame in the new one, see `rows_of`.
        x: First coordinate of the point, m.
        y: Second coordinate, m.
        z: Third coordinate, m.
    """
    a, b, c = rows
    return (
        a[0] * x + a[1] * y + a[2] * z + a[3],
        b[0] * x + b[1] * y + b[2] * z + b[3],
        c[0] * x + c[1] * y + c[2] * z + c[3],
    )


@njit(cache=True, nogil=True)
def optics_of(optics, row):  # type: ignore[no-untyped-def]
    """Return a row of optics as a tuple: focal length, principal point, width and height, px."""
    return optics[row, 0], optics[row, 1], optics[row, 2], optics[row, 3], optics[row, 4]


@njit(cache=True, nogil=True)
def image_point(optics, x, y, z):  # type: ignore[no-untyped-def]
    """Image of a point in the camera's frame.

    Args:
        optics: See `optics_of`.
        x: Coordinate to the right, m.
        y: Coordinate downward, m.
        z: Coordinate along the optical axis, m.

    Returns:
        Column and row, px, and True if the point is in front of the camera and in the image. Points behind the camera
        have the principal point.
    """
    focal, column, line, width, height = optics
    if z < LEAST_DEPTH:
        return column, line, False
    scale = focal / z
    u, v = scale * x + column, scale * y + line
    return u, v, 0.0 <= u <= width and 0.0 <= v <= height


@njit(cache=True, nogil=True)
def twist_columns(lines, x, y, z, columns):  # type: ignore[no-untyped-def]
    """Write the geometric Jacobian at a point: velocity of the point and angular velocity per joint rate.

    Args:
        lines: Directions and points of the axes, see `axes_now`. Shape (n, 6).
        x: First coordinate of the point in the base frame, m.
        y: Second coordinate, m.
        z: Third coordinate, m.
        columns: Output, one row for each joint. Shape (n, 6).
    """
    for j in range(lines.shape[0]):
        ax, ay, az = lines[j, 0], lines[j, 1], lines[j, 2]
        rx, ry, rz = x - lines[j, 3], y - lines[j, 4], z - lines[j, 5]
        columns[j, 0], columns[j, 1], columns[j, 2] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx
        columns[j, 3], columns[j, 4], columns[j, 5] = ax, ay, az


@njit(cache=True, nogil=True)
def approach_pose(arm, wanted, angles, row):  # type: ignore[no-untyped-def]
    """Move joint angles, in place, to where the tool comes near a wanted pose: damped least squares.

    Args:
        arm: An `ArmTables`.
        wanted: The pose to reach; arms of fewer than six joints come as near as they can. Shape (3, 4), m.
        angles: Joint angles to start from; one row is changed. Shape (N, n), rad.
        row: This row.
    """
    n = angles.shape[1]
    chain, now, lines = np.empty((3, 4)), np.empty((3, 4)), np.empty((n, 6))
    error, normal, step = np.empty(6), np.empty((n, n)), np.empty(n)
    columns = np.empty((n, 6))
    for _ in range(_ITERATIONS):
        axes_now(arm.axes, arm.points, arm.tool, angles, row, chain, lines, now)
        for i in range(3):
            error[i] = wanted[i, 3] - now[i, 3]
            error[3 + i] = 0.0
        # Half the sum of the cross products of matching axes: the rotation vector times sin(angle) / angle.
        for j in range(3):
            error[3] += 0.5 * (now[1, j] * wanted[2, j] - now[2, j] * wanted[1, j])
            error[4] += 0.5 * (now[2, j] * wanted[0, j] - now[0, j] * wanted[2, j])
            error[5] += 0.5 * (now[0, j] * wanted[1, j] - now[1, j] * wanted[0, j])
        twist_columns(lines, now[0, 3], now[1, 3], now[2, 3], columns)
        for j in range(n):
            step[j] = 0.0
            for i in range(6):
                step[j] += columns[j, i] * error[i]
            for k in range(n):
                normal[j, k] = _DAMPING if j == k else 0.0
                for i in range(6):
                    normal[j, k] += columns[j, i] * columns[k, i]
        _solve_in_place(normal, step)
        for j in range(n):
            angles[row, j] += step[j]


@njit(cache=True, nogil=True)
def _solve_in_place(matrix, vector):  # type: ignore[no-untyped-def]
    """Solve a symmetric positive definite system by Cholesky's method; both arguments are overwritten."""
    n = len(vector)
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
        pivot = math.sqrt(matrix[j, j])
        for i in range(j, n):
            matrix[i, j] /= pivot
    for j in range(n):
        for k in range(j):
            vector[j] -= matrix[j, k] * vector[k]
        vector[j] /= matrix[j, j]
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            vector[j] -= matrix[k, j] * vector[k]
        vector[j] /= matrix[j, j]


@njit(cache=True, nogil=True)
def angle_between(first, second):  # type: ignore[no-untyped-def]
    """Rotation angle between two poses, rad; exact near 0 and near pi."""
    trace, skew = 0.0, 0.0
    for i in range(3):
        for j in range(3):
            trace += first[i, j] * second[i, j]
    # The chord |R1 - R2| = 2 sqrt(2) |sin(angle / 2)| keeps the digits that the arc cosine loses near 0.
    for i in range(3):
        for j in range(3):
            skew += (first[i, j] - second[i, j]) ** 2
    sine, cosine = math.sqrt(skew / 8.0), math.sqrt(max(1.0 + trace, 0.0)) / 2.0
    return 2.0 * math.atan2(sine, cosine)


@njit(cache=True, nogil=True)
def gravity_torques(lines, tool, masses, torques):  # type: ignore[no-untyped-def]
    """Write the torque of gravity about each joint into `torques`. Shape (n,), N m.

    Args:
        lines: Directions and points of the axes, see `axes_now`. Shape (n, 6).
        tool: Pose of the tool. Shape (3, 4), m.
        masses: Masses of the links, each in the middle between its joint and the next. Shape (n,), kg.
        torques: Output.
    """
    n = masses.shape[0]
    weight, mx, my = 0.0, 0.0, 0.0
    end_x, end_y = tool[0, 3], tool[1, 3]
    # From the tip to the base: weight of the links behind a joint, and its moments about the base's axes.
    for back in range(n):
        j = n - 1 - back
        x, y = lines[j, 3], lines[j, 4]
        link = GRAVITY * masses[j]
        weight += link
        mx += 0.5 * link * (x + end_x)
        my += 0.5 * link * (y + end_y)
        end_x, end_y = x, y
        # Force (0, 0, -m g): only two entries of the moment arm count.
        torques[j] = lines[j, 1] * (mx - weight * x) - lines[j, 0] * (my - weight * y)


def largest_torque(arm: ArmTables) -> float:
    """Torque of gravity about the second joint with the arm stretched out horizontally, N m: the scale of sag."""
    joints = [*arm.points[1:], arm.tool[:3, 3]]
    lengths = [math.dist(a, b) for a, b in itertools.pairwise(joints)]
    reach, total = 0.0, 0.0
    for mass, length in zip(arm.masses[1:], lengths, strict=True):
        total += GRAVITY * float(mass) * (reach + 0.5 * length)
        reach += length
    return total
