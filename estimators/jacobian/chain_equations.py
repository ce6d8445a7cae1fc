"""Normal equations of a rigid chain: what frames and prior add to them, and their factorization.

The cost is the negative logarithm of Student's t densities of the residuals and of weak Gaussian priors, which fix the
gauge (the mean depth is 1) and keep what has not been excited finite.
"""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_kernel import (
    chain_features,
    chain_motions,
    placed,
    point_derivatives,
)


@njit(cache=True, nogil=True)
def row_terms(residual, weight, noise, settings):  # type: ignore[no-untyped-def]
    """Return the cost of a residual and its weight in the normal equations: Student's t distribution."""
    precision = 1.0 / (noise * (1.0 / weight + 1.0 / settings.most_frames))
    excess = residual * residual * precision / settings.freedom
    share = settings.freedom + 1.0
    return 0.5 * share * math.log1p(excess), share / settings.freedom * precision / (1.0 + excess)


@njit(cache=True, nogil=True)
def _add_point(rows, wrenches, point, weights, residuals, gram, normal, slope):  # type: ignore[no-untyped-def]
    """Add a point to the lower triangle of the normal equations; its derivatives by other points are 0.

    Args:
        rows: See `point_derivatives`. Shape (2, 6n + 6).
        wrenches: See `point_derivatives`. Shape (2, 6).
        point: Index of the point.
        weights: Weights of both coordinates, see `row_terms`.
        residuals: Residuals of both coordinates, px.
        gram: Weighted squares of the wrenches, of which `_add_twists` makes what belongs to the twists; changed.
            Shape (6, 6).
        normal: Normal equations; changed. Shape (N, N).
        slope: Gradient; changed. Shape (N,).
    """
    shared, size = rows.shape[1] - 6, slope.shape[0]
    own, tail = shared + 3 * point, size - 3
    for i in range(6):
        for k in range(6):
            gram[i, k] += weights[0] * wrenches[0, i] * wrenches[0, k] + weights[1] * wrenches[1, i] * wrenches[1, k]
    u, v = weights[0] * residuals[0], weights[1] * residuals[1]
    for a in range(shared):
        slope[a] += u * rows[0, a] + v * rows[1, a]
    for c in range(6):
        u, v = weights[0] * rows[0, shared + c], weights[1] * rows[1, shared + c]
        a = own + c if c < 3 else tail + c - 3
        slope[a] += u * residuals[0] + v * residuals[1]
        for b in range(shared):
            normal[a, b] += u * rows[0, b] + v * rows[1, b]
        for d in range(c + 1):
            b = own + d if d < 3 else tail + d - 3
            normal[a, b] += u * rows[0, shared + d] + v * rows[1, shared + d]


@njit(cache=True, nogil=True)
def _add_twists(motions, gram, half, normal):  # type: ignore[no-untyped-def]
    """Add a frame's points to the part of the normal equations that belongs to the twists: M' G M.

    However many points there are, their derivatives by the twists are wrenches times the same six rows of M.

    Args:
        motions: M, see `chain_motions`. Shape (6, 6n).
        gram: G, see `_add_point`. Shape (6, 6).
        half: Overwritten. Shape (6, 6n).
        normal: Normal equations; changed. Shape (N, N).
    """
    shared = motions.shape[1]
    for i in range(6):
        for b in range(shared):
            half[i, b] = (
                (gram[i, 0] * motions[0, b] + gram[i, 1] * motions[1, b])
                + (gram[i, 2] * motions[2, b] + gram[i, 3] * motions[3, b])
                + (gram[i, 4] * motions[4, b] + gram[i, 5] * motions[5, b])
            )
    for a in range(shared):
        s, t, u = motions[0, a], motions[1, a], motions[2, a]
        x, y, z = motions[3, a], motions[4, a], motions[5, a]
        if s != 0.0 or t != 0.0 or u != 0.0:
            for b in range(a + 1):
                normal[a, b] += (
                    (s * half[0, b] + t * half[1, b])
                    + (u * half[2, b] + x * half[3, b])
                    + (y * half[4, b] + z * half[5, b])
                )
        elif x != 0.0 or y != 0.0 or z != 0.0:
            # The velocity of a twist turns nothing.
            for b in range(a + 1):
                normal[a, b] += (x * half[3, b] + y * half[4, b]) + z * half[5, b]


@njit(cache=True, nogil=True)
def prior_cost(parameters, excited, settings, normal, slope):  # type: ignore[no-untyped-def]
    """Add the prior to the normal equations, unless they are empty, and return its cost.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        excited: Standard deviation of the constraints |w| = 1 and w . v = 0 of each joint. Shape (n,).
        settings: A `ChainSettings`.
        normal: Shape (N, N), or (0, 0).
        slope: Shape (N,), or (0,).
    """
    n = excited.shape[0]
    points = (parameters.shape[0] - 6 * n - 3) // 3
    full = slope.shape[0] > 0
    cost = 0.0
    for k in range(n):
        w = parameters[6 * k : 6 * k + 6]
        turning = settings.turning[k]
        spread = settings.axis_spread if turning else settings.rigidity
        for i in range(6):
            deviation = spread if i < 3 else settings.moment_spread
            cost += 0.5 * (w[i] / deviation) ** 2
            if full:
                slope[6 * k + i] += w[i] / deviation**2
                normal[6 * k + i, 6 * k + i] += 1.0 / deviation**2
        if not turning:
            continue
        length = w[0] * w[0] + w[1] * w[1] + w[2] * w[2] - 1.0
        pitch = w[0] * w[3] + w[1] * w[4] + w[2] * w[5]
        precision = 1.0 / excited[k] ** 2
        cost += 0.5 * precision * (length * length + pitch * pitch)
        if not full:
            continue
        for i in range(6):
            a = 2.0 * w[i] if i < 3 else 0.0
            c = w[i + 3] if i < 3 else w[i - 3]
            slope[6 * k + i] += precision * (a * length + c * pitch)
            for j in range(i + 1):
                b = 2.0 * w[j] if j < 3 else 0.0
                d = w[j + 3] if j < 3 else w[j - 3]
                normal[6 * k + i, 6 * k + j] += precision * (a * b + c * d)
    mean = 0.0
    for j in range(points):
        at = 6 * n + 3 * j
        mean += (parameters[at + 2] - 1.0) / points
        for i in range(3):
            deviation = settings.relief_spread if i == 2 else 3.0
            value = parameters[at + i] - (1.0 if i == 2 else 0.0)
            cost += 0.5 * (value / deviation) ** 2
            if full:
                slope[at + i] += value / deviation**2
                normal[at + i, at + i] += 1.0 / deviation**2
    # The scale: nothing else depends on the mean depth.
    precision = 1.0 / settings.rigidity**2
    cost += 0.5 * precision * mean * mean
    if full:
        for j in range(points):
            at = 6 * n + 3 * j + 2
            slope[at] += precision * mean / points
            for other in range(j + 1):
                normal[at, 6 * n + 3 * other + 2] += precision / points**2
    for i in range(3):
        at = 6 * n + 3 * points + i
        deviation = settings.focal_spread if i == 0 else settings.center_spread
        cost += 0.5 * (parameters[at] / deviation) ** 2
        if full:
            slope[at] += parameters[at] / deviation**2
            normal[at, at] += 1.0 / deviation**2
    return cost


@njit(cache=True, nogil=True)
def stored_terms(  # type: ignore[no-untyped-def]
    parameters, reverse, angles, features, weights, noise, settings, normal, slope, predicted
):
    """Add all keyframes to the normal equations, unless they are empty, and return their cost.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        reverse: True if the last joint is next to the camera.
        angles: Joint angles of the keyframes. Shape (K, n), rad.
        features: Features of the keyframes. Shape (K, m), px.
        weights: Weights of the features; keyframes without any are left out. Shape (K, m).
        noise: Variance of a feature, px^2.
        settings: A `ChainSettings`.
        normal: Shape (N, N), or (0, 0).
        slope: Shape (N,), or (0,).
        predicted: Output: features of the chain at the keyframes that are used. Shape (K, m), px.
    """
    n, p = angles.shape[1], features.shape[1] // 2
    full = slope.shape[0] > 0
    rates, motions, rows = np.empty((6, 0)), np.empty((6, 6 * n if full else 0)), np.empty((2, 6 * n + 6))
    wrenches, gram, half = np.empty((2, 6)), np.empty((6, 6)), np.empty((6, 6 * n if full else 0))
    tail = 6 * n + 3 * p
    focal = settings.focal * math.exp(parameters[tail])
    cost = 0.0
    for k in range(angles.shape[0]):
        if not any_weight(weights[k]):
            continue
        if not full:
            chain_features(parameters, angles[k], reverse, settings.focal, predicted[k])
            for i in range(2 * p):
                if weights[k, i] > 0.0:
                    cost += row_terms(predicted[k, i] - features[k, i], weights[k, i], noise, settings)[0]
            continue
        pose = chain_motions(parameters, angles[k], reverse, rates, motions)
        # The cost of a frame is a sum of its own, to which the other frames' are added.
        frame_cost = 0.0
        gram[:] = 0.0
        for j in range(p):
            point = placed(pose, parameters, 6 * n + 3 * j)
            point_derivatives(pose, motions, point, focal, settings.focal, rows, wrenches)
            first, second = 0.0, 0.0
            for r in range(2):
                predicted[k, 2 * j + r] = rows[r, 6 * n + 3] + settings.focal * parameters[tail + 1 + r]
            residual = predicted[k, 2 * j] - features[k, 2 * j], predicted[k, 2 * j + 1] - features[k, 2 * j + 1]
            if weights[k, 2 * j] > 0.0:
                part, first = row_terms(residual[0], weights[k, 2 * j], noise, settings)
                frame_cost += part
            if weights[k, 2 * j + 1] > 0.0:
                part, second = row_terms(residual[1], weights[k, 2 * j + 1], noise, settings)
                frame_cost += part
            if first != 0.0 or second != 0.0:
                _add_point(rows, wrenches, j, (first, second), residual, gram, normal, slope)
        _add_twists(motions, gram, half, normal)
        cost += frame_cost
    return cost


@njit(cache=True, nogil=True)
def any_weight(weights):  # type: ignore[no-untyped-def]
    """Return True if a keyframe has a feature that counts. Shape (m,)."""
    found = False
    for i in range(weights.shape[0]):
        found = found or weights[i] > 0.0
    return found


@njit(cache=True, nogil=True)
def constraint_deviations(angles, weights, noise, settings, excited):  # type: ignore[no-untyped-def]
    """Write the deviations of the constraints of each joint: a joint that has hardly moved may have any twist."""
    for k in range(angles.shape[1]):
        low, high = np.inf, -np.inf
        for f in range(angles.shape[0]):
            if any_weight(weights[f]):
                low, high = min(low, angles[f, k]), max(high, angles[f, k])
        moved = settings.focal * max(high - low, 0.0)
        excited[k] = settings.rigidity + settings.caution * math.sqrt(noise) / max(moved, 1e-3 * math.sqrt(noise))


# Lower triangles and factors R'R of them, from the last row on: all inner loops begin at 0, so that the compiler uses
# vector instructions.


@njit(cache=True, nogil=True)
def factored(normal, damping, least_pivot, factor):  # type: ignore[no-untyped-def]
    """Write the lower triangle R of normal + damping diag(normal) = R'R; return False if there is none."""
    size = normal.shape[0]
    for a in range(size):
        for b in range(a + 1):
            factor[a, b] = normal[a, b]
        factor[a, a] *= 1.0 + damping
    for back in range(size):
        k = size - 1 - back
        pivot = factor[k, k]
        if not pivot > least_pivot * normal[k, k]:
            return False
        root = 1.0 / math.sqrt(pivot)
        for b in range(k + 1):
            factor[k, b] *= root
        for a in range(k):
            value = factor[k, a]
            if value != 0.0:
                for b in range(a + 1):
                    factor[a, b] -= value * factor[k, b]
    return True


@njit(cache=True, nogil=True)
def whiten(factor, columns):  # type: ignore[no-untyped-def]
    """Solve R' Z = C in place, so that Z'Z = C' (R'R)^-1 C. Shapes (N, N) and (N, r)."""
    size, width = columns.shape
    for back in range(size):
        k = size - 1 - back
        scale = 1.0 / factor[k, k]
        for c in range(width):
            columns[k, c] *= scale
        for a in range(k):
            value = factor[k, a]
            if value != 0.0:
                for c in range(width):
                    columns[a, c] -= value * columns[k, c]


@njit(cache=True, nogil=True)
def descent(factor, slope, step):  # type: ignore[no-untyped-def]
    """Write the solution of R'R step = -slope."""
    size = slope.shape[0]
    for a in range(size):
        step[a] = -slope[a]
    for back in range(size):
        k = size - 1 - back
        step[k] /= factor[k, k]
        for a in range(k):
            step[a] -= factor[k, a] * step[k]
    unwhiten(factor, step)


@njit(cache=True, nogil=True)
def unwhiten(factor, step):  # type: ignore[no-untyped-def]
    """Solve R x = z in place. Shapes (N, N) and (N,)."""
    for k in range(step.shape[0]):
        for a in range(k):
            step[k] -= factor[k, a] * step[a]
        step[k] /= factor[k, k]
