"""Predictions of a rigid chain: how well it foresees a new frame, what is left of it, and the present."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_equations import whiten
from servotrack.estimators.jacobian.chain_kernel import chain_derivatives, jacobian_derivatives
from servotrack.estimators.jacobian.chain_keyframes import chain_residuals
from servotrack.estimators.jacobian.chain_target import (
    at_rest,
    correct_target,
    moved_target,
    spread,
    target_derivatives,
)


@njit(cache=True, nogil=True)
def better_chain(memory, row):  # type: ignore[no-untyped-def]
    """Return the index of the chain with the lower cost."""
    return 1 if memory.cost[row, 1] < memory.cost[row, 0] else 0


@njit(cache=True, nogil=True)
def foresee(seen_joints, seen_features, jacobian, joints):  # type: ignore[no-untyped-def]
    """Return the features that a linear filter foresees from the joints' motion since each was seen. Shape (rows, m).

    Args:
        seen_joints: Joint angles when each feature was seen. Shape (rows, m, n), rad.
        seen_features: Each feature then. Shape (rows, m), px.
        jacobian: Total image Jacobian. Shape (rows, m, n + 1).
        joints: Joint angles of the newest frame. Shape (rows, n), rad.
    """
    foreseen = seen_features.copy()
    for row in range(foreseen.shape[0]):
        for i in range(foreseen.shape[1]):
            for k in range(joints.shape[1]):
                foreseen[row, i] += jacobian[row, i, k] * (joints[row, k] - seen_joints[row, i, k])
    return foreseen


@njit(cache=True, nogil=True)
def score_frame(memory, frame, settings, output, newest, old, row):  # type: ignore[no-untyped-def]
    """Score the prediction of a new frame by the chain so far, beside that of the linear filter.

    Returns the whitened derivatives of the features by the parameters. Shape (N, m).
    """
    n, m = frame.angles.shape[1], frame.features.shape[1]
    best = better_chain(memory, row)
    parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
    moves = memory.moves[row]
    if moves:
        parameters = moved_target(parameters, n, memory.motion[row])
    size = len(parameters)
    predicted, by_angles, derivatives = np.empty(m), np.empty((m, n)), np.zeros((m, size))
    chain_derivatives(parameters, newest[0][0], reverse, settings.focal, predicted, by_angles, derivatives)
    columns = derivatives.T.copy()
    whiten(memory.factor[row], columns)
    fading = math.exp(-frame.duration[row] / settings.offset_time)
    settled = 1.0 - math.exp(-frame.duration[row] / settings.settling)
    rows = target_derivatives(parameters, derivatives, n, memory.motion[row]) if moves else np.empty((m, 6))
    innovations = np.zeros(m)
    squares, linear, both = 0.0, 0.0, 0
    normalized, density, used, bare = 0.0, 0.0, 0, 0.0
    for i in range(m):
        if not old[i]:
            continue
        innovation = newest[1][0, i] - predicted[i] - fading * memory.offset[row, i]
        innovations[i] = innovation
        variance = memory.white[row] + memory.offset_variance[row, i]
        if moves:
            variance += spread(rows, memory.motion_covariance[row], 0, i)
        for a in range(size):
            variance += columns[a, i] ** 2
        normalized += innovation * innovation / variance
        density -= 0.5 * (innovation * innovation / variance + math.log(2.0 * math.pi * variance))
        # An offset that follows what a wrong chain leaves would hide that it is wrong.
        residual = newest[1][0, i] - predicted[i]
        left = residual - memory.recent[row, i]
        memory.recent[row, i] += settled * left
        variance += memory.noise[row] * (1.0 + settled) - memory.white[row] - memory.offset_variance[row, i]
        bare -= 0.5 * (left * left / variance + math.log(variance))
        used += 1
        if frame.compared[row, i]:
            squares += innovation * innovation
            linear += frame.linear_error[row, i] ** 2
            both += 1
    if used > 0:
        output.nis[row] = normalized / used
        output.log_likelihood[row] = density
        memory.evidence[row] = settings.forgetting * memory.evidence[row] + bare / used
    if both > 0:
        keep = 1.0 - 1.0 / settings.memory
        errors = memory.errors[row]
        errors[0] = keep * errors[0] + (1.0 - keep) * linear / both
        errors[1] = keep * errors[1] + (1.0 - keep) * squares / both
    if moves and used > 0:
        forecast = memory.motion[row].copy()
        correct_target(memory, innovations, old, rows, columns, settings, row)
        at_rest(memory, forecast, newest, rows, best, settings, row)
    return columns


@njit(cache=True, nogil=True)
def follow_offsets(memory, frame, settings, newest, row):  # type: ignore[no-untyped-def]
    """Filter what the chain leaves of the features: an offset of its own for each, with a decaying correlation.

    White noise has no offsets: their variance is the mean product of successive residuals, and the rest of the
    residuals' variance is white noise. Outliers are bounded.
    """
    m = frame.features.shape[1]
    residual = np.empty(m)
    best = better_chain(memory, row)
    parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
    chain_residuals(parameters, reverse, newest[0][0], newest[1][0], settings, residual)
    fading = math.exp(-frame.duration[row] / settings.offset_time)
    product, square, count = 0.0, 0.0, 0
    largest = math.sqrt(settings.outlier * memory.noise[row])
    for i in range(m):
        if frame.seen[row, i]:
            bounded = min(max(residual[i], -largest), largest)
            product += bounded * memory.residual[row, i]
            square += bounded * bounded
            memory.residual[row, i] = bounded
            count += 1
    if count > 0:
        memory.offset_power[row] += (product / count - memory.offset_power[row]) / settings.memory
        memory.residual_power[row] += (square / count - memory.residual_power[row]) / settings.memory
    # Two standard deviations of the mean product of white residuals count as none.
    chance = 2.0 * memory.residual_power[row] / math.sqrt(2.0 * settings.memory * max(count, 1))
    # The motion of a target explains what remains correlated.
    power = memory.offset_power[row] if memory.offset_power[row] > chance and not memory.moves[row] else 0.0
    noise = max(memory.residual_power[row] - power, settings.least_noise**2)
    memory.white[row] = noise
    for i in range(m):
        variance = fading * fading * memory.offset_variance[row, i] + (1.0 - fading * fading) * power
        offset = fading * memory.offset[row, i]
        if frame.seen[row, i]:
            innovation = residual[i] - offset
            excess = innovation * innovation / (settings.outlier * (variance + noise))
            gain = variance / (variance + noise * max(1.0, excess))
            offset += gain * innovation
            variance *= 1.0 - gain
        memory.offset[row, i], memory.offset_variance[row, i] = offset, variance


@njit(cache=True, nogil=True)
def write_present(memory, frame, settings, output, row):  # type: ignore[no-untyped-def]
    """Write features and Jacobian at the present posture, and their covariances."""
    n, m = frame.angles.shape[1], frame.features.shape[1]
    best = output.best[row]
    parameters = memory.parameters[row, best].copy()
    size = parameters.shape[0]
    moves, age = memory.moves[row], frame.pending[row]
    motion, doubt = memory.motion[row].copy(), memory.motion_covariance[row]
    if moves:
        motion[:6] += age * motion[6:]
        parameters = moved_target(parameters, n, motion)
    output.parameters[row] = parameters
    theta = frame.present[row] - memory.origin[row]
    reverse, focal_unit = memory.reverse[row, best], settings.focal
    jacobian, columns = np.empty((m, n)), np.empty((size, m * n + m))
    jacobian_derivatives(parameters, theta, reverse, focal_unit, output.features[row], jacobian, columns)
    derivatives = columns[:, m * n :].T
    rows = target_derivatives(parameters, derivatives, n, motion) if moves else np.empty((m, 6))
    whiten(memory.factor[row], columns)
    spreads = np.zeros((n, n, m))
    for a in range(size):
        for k in range(n):
            for j in range(k + 1):
                for i in range(m):
                    spreads[k, j, i] += columns[a, k * m + i] * columns[a, j * m + i]
    for i in range(m):
        output.features[row, i] += memory.offset[row, i]
        total = memory.offset_variance[row, i]
        for a in range(size):
            total += columns[a, m * n + i] ** 2
        if moves:
            total += spread(rows, doubt, 0, i) + age * age * spread(rows, doubt, 6, i)
        output.variance[row, i] = total
        covariance = output.covariance[row, i]
        for k in range(n):
            for j in range(k + 1):
                covariance[k, j], covariance[j, k] = spreads[k, j, i], spreads[k, j, i]
        # Whether the target moves is settled by comparison: no doubt of its rates, as the law sees it.
        covariance[n, n] = 0.0 if moves else settings.drift**2
        if moves:
            for a in range(6):
                output.jacobian[row, i, n] += rows[i, a] * motion[6 + a]
        for k in range(n):
            # Rounding must not leave it indefinite.
            covariance[k, k] *= 1.0 + 1e-9
            output.jacobian[row, i, k] = jacobian[i, k]
