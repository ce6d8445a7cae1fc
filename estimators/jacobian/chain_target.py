"""Motion of the target of a rigid chain: a board that moves by itself, filtered from what the chain leaves unexplained.

The points of a rigid board that moves are at c + exp([w]) (X - c) + t, with c = (0, 0, 1) at the mean depth before the
camera of the first frame. Turn w, shift t and their rates are a Kalman filter's state. A rate changes by about its own
size within a second (white acceleration; Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, sec. 6.2), so that a board that rests does not appear to move. The filter does not correct the chain's
parameters but counts their uncertainty as noise (Schmidt 1966, consider parameters): while a joint moves whose axis is
unknown, the board is where its rates say. From such frames the chain learns what they would show of a board at rest.
"""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_kernel import chain_features, joint_pose


@njit(cache=True, nogil=True)
def forecast_target(memory, duration, settings, row):  # type: ignore[no-untyped-def]
    """Advance the target's motion of a row by a duration, s."""
    motion, covariance = memory.motion[row], memory.motion_covariance[row]
    for part in range(2):
        speed, doubt = 0.0, 0.0
        for a in range(6 + 3 * part, 9 + 3 * part):
            speed += motion[a] ** 2
            doubt += covariance[a, a]
        turning = settings.target_turn**2 * speed * speed / (speed + 4.0 * doubt) if speed > 0.0 else 0.0
        power = settings.target_change**2 + turning / 3.0
        for a in range(3 * part, 3 * part + 3):
            for b in range(12):
                covariance[a, b] += duration * covariance[6 + a, b]
            for b in range(12):
                covariance[b, a] += duration * covariance[b, 6 + a]
            covariance[a, a] += power * duration**3 / 3.0
            covariance[a, 6 + a] += power * duration**2 / 2.0
            covariance[6 + a, a] += power * duration**2 / 2.0
            covariance[6 + a, 6 + a] += power * duration
    for a in range(6):
        motion[a] += duration * motion[6 + a]


@njit(cache=True, nogil=True)
def moved_target(parameters, joints, motion):  # type: ignore[no-untyped-def]
    """Return parameters of a chain with its points where a motion has taken them. Shape (N,)."""
    moved = parameters.copy()
    first, second, third = joint_pose(motion, 0, 1.0)
    for at in range(6 * joints, len(parameters) - 3, 3):
        x, y, z = parameters[at], parameters[at + 1], parameters[at + 2] - 1.0
        moved[at] = first[0] * x + first[1] * y + first[2] * z + motion[3]
        moved[at + 1] = second[0] * x + second[1] * y + second[2] * z + motion[4]
        moved[at + 2] = third[0] * x + third[1] * y + third[2] * z + motion[5] + 1.0
    return moved


@njit(cache=True, nogil=True)
def place_target(parameters, joints, motion, new):  # type: ignore[no-untyped-def]
    """Put new points, which are where they are seen, to where they were before the motion; in place."""
    first, second, third = joint_pose(motion, 0, 1.0)
    for j in range(len(new) // 2):
        if new[2 * j]:
            at = 6 * joints + 3 * j
            x, y, z = parameters[at] - motion[3], parameters[at + 1] - motion[4], parameters[at + 2] - 1.0 - motion[5]
            parameters[at] = first[0] * x + second[0] * y + third[0] * z
            parameters[at + 1] = first[1] * x + second[1] * y + third[1] * z
            parameters[at + 2] = first[2] * x + second[2] * y + third[2] * z + 1.0


@njit(cache=True, nogil=True)
def target_derivatives(moved, derivatives, joints, motion):  # type: ignore[no-untyped-def]
    """Return the derivatives of the features by turn and shift of the target. Shape (m, 6), px/rad and px.

    Args:
        moved: Parameters, see `moved_target`. Shape (N,).
        derivatives: Derivatives of the features by the parameters. Shape (m, N).
        joints: Number of joints.
        motion: Turn and shift, and their rates. Shape (12,).
    """
    m = derivatives.shape[0]
    rows = np.empty((m, 6))
    for i in range(m):
        at = 6 * joints + 3 * (i // 2)
        x, y, z = moved[at] - motion[3], moved[at + 1] - motion[4], moved[at + 2] - 1.0 - motion[5]
        gx, gy, gz = derivatives[i, at], derivatives[i, at + 1], derivatives[i, at + 2]
        rows[i, 0], rows[i, 1], rows[i, 2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        rows[i, 3], rows[i, 4], rows[i, 5] = gx, gy, gz
    return rows


@njit(cache=True, nogil=True)
def spread(rows, covariance, at, i):  # type: ignore[no-untyped-def]
    """Variance of a feature, or of its velocity, by the block of the covariance that begins at `at`."""
    variance = 0.0
    for a in range(6):
        for b in range(6):
            variance += rows[i, a] * covariance[at + a, at + b] * rows[i, b]
    return max(variance, 0.0)


@njit(cache=True, nogil=True)
def correct_target(memory, innovations, used, rows, columns, settings, row):  # type: ignore[no-untyped-def]
    """Update the target's motion of a row with the innovations of a frame.

    Args:
        memory: A `ChainMemory`; changed.
        innovations: Shape (m,), px.
        used: Mask of the features that count, at least one. Shape (m,).
        rows: See `target_derivatives`.
        columns: Whitened derivatives of the features by the parameters. Shape (N, m).
        settings: A `ChainSettings`.
        row: Row of the batch.
    """
    motion, covariance = memory.motion[row], memory.motion_covariance[row]
    index = np.flatnonzero(used)
    count = len(index)
    # Both terms of the noise are uncertain parameters and white noise, which is positive: no pivot vanishes.
    noise, total = np.empty((count, count)), np.empty((count, count))
    right = np.zeros((count, 13))
    for c in range(count):
        for a in range(12):
            for b in range(6):
                right[c, a] += covariance[a, b] * rows[index[c], b]
        right[c, 12] = innovations[index[c]]
    for c in range(count):
        for d in range(c + 1):
            own, carried = 0.0, 0.0
            for a in range(columns.shape[0]):
                own += columns[a, index[c]] * columns[a, index[d]]
            for a in range(6):
                carried += rows[index[c], a] * right[d, a]
            if c == d:
                # An outlier counts as noisy as it is far off.
                white = memory.white[row] + memory.offset_variance[row, index[c]]
                excess = right[c, 12] ** 2 / (settings.outlier * (white + own + carried))
                own += white * max(1.0, excess)
            noise[c, d], noise[d, c] = own, own
            total[c, d], total[d, c] = own + carried, own + carried
    cross = right[:, :12].copy()
    eliminate(total, right)
    for a in range(12):
        for c in range(count):
            motion[a] += cross[c, a] * right[c, 12]
    _shrink(covariance, right, rows, index, noise)


@njit(cache=True, nogil=True)
def eliminate(matrix, right):  # type: ignore[no-untyped-def]
    """Solve matrix x = right in place, by elimination without pivots: the matrix is definite."""
    n, width = right.shape
    for k in range(n):
        for a in range(k + 1, n):
            share = matrix[a, k] / matrix[k, k]
            for b in range(k, n):
                matrix[a, b] -= share * matrix[k, b]
            for b in range(width):
                right[a, b] -= share * right[k, b]
    for back in range(n):
        k = n - 1 - back
        for b in range(width):
            value = right[k, b]
            for a in range(k + 1, n):
                value -= matrix[k, a] * right[a, b]
            right[k, b] = value / matrix[k, k]


@njit(cache=True, nogil=True)
def _shrink(covariance, gains, rows, index, noise):  # type: ignore[no-untyped-def]
    """Update a covariance in Joseph's form, which stays positive semidefinite whatever is rounded; in place.

    Args:
        covariance: Covariance of the motion; changed. Shape (12, 12).
        gains: Transposed gains in the first columns. Shape (c, 13).
        rows: See `target_derivatives`.
        index: Features that count. Shape (c,).
        noise: Covariance of their noise. Shape (c, c).
    """
    count = len(index)
    kept, half = np.eye(12), np.zeros((12, 12))
    for a in range(12):
        for b in range(6):
            for c in range(count):
                kept[a, b] -= gains[c, a] * rows[index[c], b]
    for a in range(12):
        for b in range(12):
            for c in range(12):
                half[a, b] += kept[a, c] * covariance[c, b]
    for a in range(12):
        for b in range(a + 1):
            value = 0.0
            for c in range(12):
                value += half[a, c] * kept[b, c]
            for c in range(count):
                for d in range(count):
                    value += gains[c, a] * noise[c, d] * gains[d, b]
            covariance[a, b], covariance[b, a] = value, value


@njit(cache=True, nogil=True)
def at_rest(memory, before, newest, rows, chain, settings, row):  # type: ignore[no-untyped-def]
    """Move the features of a frame to where they would be without the target's motion, and weigh them by its variance.

    The motion halfway between forecast and update leaves residuals with the variance of the noise, to first order: with
    S that of the innovation and R that of the noise, the residual of (1 + R / S) / 2 of it has (S + 2 R + R R / S) / 4.

    Args:
        memory: A `ChainMemory`.
        before: Forecast of the motion. Shape (12,).
        newest: Angles, features and weights of the frame; changed. Shapes (1, n), (1, m), (1, m).
        rows: See `target_derivatives`.
        chain: Index of the chain.
        settings: A `ChainSettings`.
        row: Row of the batch.
    """
    joints, m = newest[0].shape[1], newest[1].shape[1]
    parameters, reverse = memory.parameters[row, chain], memory.reverse[row, chain]
    rest, now = np.empty(m), np.empty(m)
    motion = 0.5 * (before + memory.motion[row])
    chain_features(parameters, newest[0][0], reverse, settings.focal, rest)
    chain_features(moved_target(parameters, joints, motion), newest[0][0], reverse, settings.focal, now)
    for i in range(m):
        newest[1][0, i] -= now[i] - rest[i]
        newest[2][0, i] /= 1.0 + spread(rows, memory.motion_covariance[row], 0, i) / memory.noise[row]


@njit(cache=True, nogil=True)
def restart_target(memory, settings, row):  # type: ignore[no-untyped-def]
    """Let the target's motion begin here, at an unknown rate."""
    memory.motion[row] = 0.0
    memory.motion_covariance[row] = 0.0
    for a in range(6, 12):
        memory.motion_covariance[row, a, a] = settings.target_speed**2
