"""Normal equations of a rigid chain: what frames and prior add to them, and their factorization.

The cost is the negative logarithm of Student's t densities of the residuals and of weak Gaussian priors, which fix the
gauge (the mean depth is 1) and keep what has not been excited finite.
"""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_kernel import chain_derivatives, chain_features


@njit(cache=True, nogil=True)
def row_terms(residual, weight, noise, settings):  # type: ignore[no-untyped-def]
    """Return the cost of a residual and its weight in the normal equations: Student's t distribution."""
    precision = 1.0 / (noise * (1.0 / weight + 1.0 / settings.most_frames))
    excess = residual * residual * precision / settings.freedom
    share = settings.freedom + 1.0
    return 0.5 * share * math.log1p(excess), share / settings.freedom * precision / (1.0 + excess)


@njit(cache=True, nogil=True)
def _add_frame(derivatives, residual, weights, noise, settings, normal, slope):  # type: ignore[no-untyped-def]
    """Add a frame to the lower triangle of the normal equations, and return its cost."""
    size = slope.shape[0]
    cost = 0.0
    for j in range(0, residual.shape[0], 2):
        first, second = 0.0, 0.0
        if weights[j] > 0.0:
            part, first = row_terms(residual[j], weights[j], noise, settings)
            cost += part
        if weights[j + 1] > 0.0:
            part, second = row_terms(residual[j + 1], weights[j + 1], noise, settings)
            cost += part
        if first == 0.0 and second == 0.0:
            continue
        # Both rows of a point have their zeros in the same columns.
        for a in range(size):
            u, v = first * derivatives[j, a], second * derivatives[j + 1, a]
            if u != 0.0 or v != 0.0:
                slope[a] += u * residual[j] + v * residual[j + 1]
                for b in range(a + 1):
                    normal[a, b] += u * derivatives[j, b] + v * derivatives[j + 1, b]
    return cost


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
    parameters, reverse, angles, features, weights, noise, settings, normal, slope
):
    """Add all keyframes to the normal equations, unless they are empty, and return their cost."""
    n, m, size = angles.shape[1], features.shape[1], parameters.shape[0]
    full = slope.shape[0] > 0
    predicted, scratch = np.empty(m), np.zeros((4, 3, 4))
    by_angles, derivatives = np.empty((m, n)), np.zeros((m if full else 0, size))
    cost = 0.0
    for k in range(angles.shape[0]):
        if not any_weight(weights[k]):
            continue
        if full:
            chain_derivatives(parameters, angles[k], reverse, settings.focal, predicted, by_angles, derivatives)
        else:
            chain_features(parameters, angles[k], reverse, settings.focal, predicted, scratch)
        for i in range(m):
            predicted[i] -= features[k, i]
        if full:
            cost += _add_frame(derivatives, predicted, weights[k], noise, settings, normal, slope)
        else:
            for i in range(m):
                if weights[k, i] > 0.0:
                    cost += row_terms(predicted[i], weights[k, i], noise, settings)[0]
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
    for k in range(size):
        for a in range(k):
            step[k] -= factor[k, a] * step[a]
        step[k] /= factor[k, k]
