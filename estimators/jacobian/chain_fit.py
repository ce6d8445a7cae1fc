"""Compiled fit of a rigid chain to frames: Levenberg-Marquardt over keyframes, offsets, and comparison of both orders.

Each row of a batch has keyframes: postures with the mean features of all frames there and their number. The cost is the
negative logarithm of Student's t densities of the residuals and of weak Gaussian priors, which fix the gauge (the mean
depth is 1) and keep what has not been excited finite.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_kernel import LEAST_DEPTH, chain_derivatives, chain_features, chain_pose
from servotrack.estimators.types import Array, Labels, Mask


class ChainSettings(NamedTuple):
    """Parameters of the fit.

    Attributes:
        focal: Expected focal length, px.
        turning: True for joints that turn. Shape (n,).
        axis_spread: Prior standard deviation of the components of w.
        moment_spread: Prior standard deviation of the components of v, mean depths.
        relief_spread: Prior standard deviation of a point's depth about the mean, mean depths.
        focal_spread: Prior standard deviation of log f.
        center_spread: Prior standard deviation of the principal point, focal lengths.
        rigidity: Least standard deviation of |w|^2 - 1 and of w . v.
        noise: Prior standard deviation of a feature, px.
        least_noise: Least estimate of it, px.
        freedom: Degrees of freedom of the noise.
        most_frames: Number of frames at one posture that count, the others add nothing.
        spacing: Largest difference of joint angles of frames that are merged at once, rad.
        reach: Largest difference of joint angles of keyframes that are merged for lack of space, rad.
        iterations: Iterations of the fit per step.
        memory: Memory of the comparison with the linear filter, and of the offsets' size, frames.
        offset_time: Correlation time of the offsets, s.
        margin: Factor of the mean squared errors that the chain must not exceed.
        patience: Frames of failure after which the chain starts anew.
        drift: Standard deviation of the features' velocity at rest, px/s.
        first_damping: Damping of the first fit, relative to the diagonal of the normal equations.
        least_damping: Least damping.
        largest_damping: Largest damping.
        least_pivot: Least pivot of a factorization, relative to the diagonal.
        least_gain: Expected decrease of the cost, a log likelihood, below which a fit is complete.
        small_gain: Decrease of the cost after which further iterations wait for the next frame.
        first_trial: Number of frames in which both orders are fitted side by side.
        trial: Number of frames after which a worse chain has lost.
        rarely: Number of frames between two fits of the worse chain, once it has lost often.
        failed: Ratio of the mean squared errors of chain and linear filter that counts as a failure; its square is that
            of the chain's to their own least value.
        no_error: Least error before there is one, px^2.
        outlier: Square of a residual, relative to the variance, that counts at most in the estimate of the noise.
        difference: Change of a parameter for the derivatives of the Jacobian.
    """

    focal: float
    turning: Mask
    axis_spread: float
    moment_spread: float
    relief_spread: float
    focal_spread: float
    center_spread: float
    rigidity: float
    noise: float
    least_noise: float
    freedom: float
    most_frames: float
    spacing: float
    reach: float
    caution: float
    iterations: int
    memory: float
    offset_time: float
    margin: float
    patience: float
    drift: float
    first_damping: float = 1e-3
    least_damping: float = 1e-6
    largest_damping: float = 1e6
    least_pivot: float = 1e-14
    least_gain: float = 1e-8
    small_gain: float = 0.1
    first_trial: float = 20.0
    trial: float = 12.0
    rarely: float = 8.0
    failed: float = 4.0
    no_error: float = 1e12
    outlier: float = 9.0
    difference: float = 1e-6


class ChainMemory(NamedTuple):
    """State of the chain, see `ChainState`."""

    started: Mask
    origin: Array
    angles: Array
    features: Array
    weights: Array
    scatter: Array
    known: Mask
    parameters: Array
    damping: Array
    cost: Array
    reverse: Mask
    challenge: Array
    noise: Array
    offset: Array
    offset_variance: Array
    offset_power: Array
    residual_power: Array
    white: Array
    residual: Array
    errors: Array
    failures: Array
    served: Array
    least_error: Array
    frames: Array


class ChainFrame(NamedTuple):
    """Newest frame and the present posture of each row.

    Attributes:
        fresh: True for a new frame. Shape (B,).
        angles: Joint angles at the frame's instant. Shape (B, n), rad.
        features: Features, 0 where unseen. Shape (B, m), px.
        seen: Mask of the features. Shape (B, m).
        duration: Time since the previous frame. Shape (B,), s.
        linear_error: Innovation of the linear filter. Shape (B, m), px.
        compared: Mask of the features that have such an innovation. Shape (B, m).
        present: Joint angles at present. Shape (B, n), rad.
    """

    fresh: Mask
    angles: Array
    features: Array
    seen: Mask
    duration: Array
    linear_error: Array
    compared: Mask
    present: Array


class ChainOutput(NamedTuple):
    """Results of each row: features, Jacobian by the joints, covariances and scores, see `ChainEstimate`."""

    features: Array
    jacobian: Array
    covariance: Array
    variance: Array
    log_likelihood: Array
    nis: Array
    best: Labels
    chained: Mask


@njit(cache=True, nogil=True)
def _row_terms(residual, weight, noise, settings):  # type: ignore[no-untyped-def]
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
            part, first = _row_terms(residual[j], weights[j], noise, settings)
            cost += part
        if weights[j + 1] > 0.0:
            part, second = _row_terms(residual[j + 1], weights[j + 1], noise, settings)
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
def _prior_cost(parameters, excited, settings, normal, slope):  # type: ignore[no-untyped-def]
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


# Lower triangles and factors R'R of them, from the last row on: all inner loops begin at 0, so that the compiler uses
# vector instructions.


@njit(cache=True, nogil=True)
def _factored(normal, damping, least_pivot, factor):  # type: ignore[no-untyped-def]
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
def _whiten(factor, columns):  # type: ignore[no-untyped-def]
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
def _descent(factor, slope, step):  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True)
def _stored_terms(  # type: ignore[no-untyped-def]
    parameters, reverse, angles, features, weights, noise, settings, normal, slope
):
    """Add all keyframes to the normal equations, unless they are empty, and return their cost."""
    n, m, size = angles.shape[1], features.shape[1], parameters.shape[0]
    full = slope.shape[0] > 0
    predicted, scratch = np.empty(m), np.zeros((4, 3, 4))
    by_angles, derivatives = np.empty((m, n)), np.zeros((m if full else 0, size))
    cost = 0.0
    for k in range(angles.shape[0]):
        if not _any_weight(weights[k]):
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
                    cost += _row_terms(predicted[i], weights[k, i], noise, settings)[0]
    return cost


@njit(cache=True, nogil=True)
def _any_weight(weights):  # type: ignore[no-untyped-def]
    found = False
    for i in range(weights.shape[0]):
        found = found or weights[i] > 0.0
    return found


@njit(cache=True, nogil=True)
def _constraint_deviations(angles, weights, noise, settings, excited):  # type: ignore[no-untyped-def]
    """Write the deviations of the constraints of each joint: a joint that has hardly moved may have any twist."""
    for k in range(angles.shape[1]):
        low, high = np.inf, -np.inf
        for f in range(angles.shape[0]):
            if _any_weight(weights[f]):
                low, high = min(low, angles[f, k]), max(high, angles[f, k])
        moved = settings.focal * max(high - low, 0.0)
        excited[k] = settings.rigidity + settings.caution * math.sqrt(noise) / max(moved, 1e-3 * math.sqrt(noise))


@njit(cache=True, nogil=True)
def _place_points(parameters, angles, reverse, focal_unit, features, new):  # type: ignore[no-untyped-def]
    """Put points that are seen for the first time at depth 1 on their lines of sight."""
    n, p = angles.shape[0], features.shape[0] // 2
    pose, scratch = np.empty((3, 4)), np.zeros((4, 3, 4))
    chain_pose(parameters, angles, reverse, pose, scratch)
    tail = 6 * n + 3 * p
    focal = focal_unit * math.exp(parameters[tail])
    for j in range(p):
        if not new[2 * j]:
            continue
        x = (features[2 * j] - focal_unit * parameters[tail + 1]) / focal - pose[0, 3]
        y = (features[2 * j + 1] - focal_unit * parameters[tail + 2]) / focal - pose[1, 3]
        z = 1.0 - pose[2, 3]
        for i in range(3):
            parameters[6 * n + 3 * j + i] = pose[0, i] * x + pose[1, i] * y + pose[2, i] * z


@njit(cache=True, nogil=True)
def _residuals(parameters, reverse, angles, features, settings, out):  # type: ignore[no-untyped-def]
    """Write features minus those of the chain. Shape (m,), px."""
    chain_features(parameters, angles, reverse, settings.focal, out, np.zeros((4, 3, 4)))
    for i in range(out.shape[0]):
        out[i] = features[i] - out[i]


@njit(cache=True, nogil=True)
def _merge(parameters, reverse, store, into, other, noise, settings):  # type: ignore[no-untyped-def]
    """Merge keyframe `other` into keyframe `into`, and return the squares that their mean loses.

    The mean frame is at the mean posture. Features are moved there by the chain, whose errors cancel to first order.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: Joint angles, features and weights of the keyframes. Shapes (K, n), (K, m), (K, m).
        into: Index of the first keyframe; changed.
        other: Index of the second keyframe; emptied.
        noise: Variance of a feature, px^2.
        settings: A `ChainSettings`.
    """
    angles, features, weights = store
    m = features.shape[1]
    first, second, mean = np.empty(m), np.empty(m), np.empty(m)
    _residuals(parameters, reverse, angles[into], features[into], settings, first)
    _residuals(parameters, reverse, angles[other], features[other], settings, second)
    share = weights[other].max() / (weights[into].max() + weights[other].max())
    for k in range(angles.shape[1]):
        angles[into, k] += share * (angles[other, k] - angles[into, k])
    chain_features(parameters, angles[into], reverse, settings.focal, mean, np.zeros((4, 3, 4)))
    squares = 0.0
    for i in range(m):
        total = weights[into, i] + weights[other, i]
        if total <= 0.0:
            continue
        part = weights[other, i] / total
        squares += part * weights[into, i] * min((second[i] - first[i]) ** 2, 2.0 * settings.outlier * noise)
        features[into, i] = mean[i] + (1.0 - part) * first[i] + part * second[i]
        weights[into, i] = total
        weights[other, i] = 0.0
    return squares


@njit(cache=True, nogil=True)
def _apart(angles, a, b):  # type: ignore[no-untyped-def]
    """Largest difference of the joint angles of two keyframes."""
    largest = 0.0
    for k in range(angles.shape[1]):
        largest = max(largest, abs(angles[a, k] - angles[b, k]))
    return largest


@njit(cache=True, nogil=True)
def _free_slot(parameters, reverse, store, noise, settings):  # type: ignore[no-untyped-def]
    """Return an empty keyframe, and the squares that merging loses; if there is none, the nearest two become one."""
    angles, _, weights = store
    count = angles.shape[0]
    for k in range(count):
        if not _any_weight(weights[k]):
            return k, 0.0
    first, second, nearest = 0, 1, np.inf
    for a in range(count):
        for b in range(a + 1, count):
            distance = _apart(angles, a, b)
            if distance < nearest:
                first, second, nearest = a, b, distance
    if nearest <= settings.reach:
        return second, _merge(parameters, reverse, store, first, second, noise, settings)
    # Too far for the chain to move features: one of the two goes.
    dropped = second if weights[first].max() > weights[second].max() else first
    weights[dropped] = 0.0
    return dropped, 0.0


@njit(cache=True, nogil=True)
def _store_frame(parameters, reverse, store, frame, noise, settings):  # type: ignore[no-untyped-def]
    """Put a frame into the store, and return the squares that merging loses.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: See `_merge`; changed.
        frame: Joint angles, features and mask of the frame. Shapes (n,), (m,), (m,).
        noise: Variance of a feature, px^2.
        settings: A `ChainSettings`.
    """
    angles, features, weights = store
    theta, seen_at, seen = frame
    slot, squares = _free_slot(parameters, reverse, store, noise, settings)
    residual = np.empty(seen.shape[0])
    _residuals(parameters, reverse, theta, seen_at, settings, residual)
    for k in range(theta.shape[0]):
        angles[slot, k] = theta[k]
    for i in range(seen.shape[0]):
        features[slot, i] = seen_at[i]
        weights[slot, i] = 0.0
        if seen[i]:
            # An outlier must not get weight by being merged.
            square = residual[i] * residual[i]
            weights[slot, i] = 1.0 if square <= settings.outlier * noise else settings.outlier * noise / square
    if not _any_weight(weights[slot]):
        return squares
    into, nearest = -1, settings.spacing
    for k in range(angles.shape[0]):
        if k != slot and _any_weight(weights[k]):
            distance = _apart(angles, k, slot)
            if distance < nearest:
                into, nearest = k, distance
    if into >= 0:
        squares += _merge(parameters, reverse, store, into, slot, noise, settings)
    return squares


@njit(cache=True, nogil=True)
def _noise_of(parameters, reverse, store, scatter, noise, settings):  # type: ignore[no-untyped-def]
    """Return the variance of a feature about the chain, from all frames."""
    angles, features, weights = store
    m = features.shape[1]
    residual = np.empty(m)
    squares, count, used = scatter, 0.0, 0.0
    for k in range(angles.shape[0]):
        if not _any_weight(weights[k]):
            continue
        _residuals(parameters, reverse, angles[k], features[k], settings, residual)
        for i in range(m):
            if weights[k, i] > 0.0:
                # Each frame counts as in the fit.
                counted = 1.0 / (1.0 / weights[k, i] + 1.0 / settings.most_frames)
                squares += min(counted * residual[i] * residual[i], settings.outlier * noise)
                count += weights[k, i]
                used += 1.0
    # Parameters fit as many residuals of keyframes as they are; half of the residuals count in any case.
    free = count - min(float(parameters.shape[0]), 0.5 * used)
    prior = 4.0
    return max((prior * settings.noise**2 + squares) / (prior + free), settings.least_noise**2)


@njit(cache=True, nogil=True)
def _improve(  # type: ignore[no-untyped-def]
    parameters, reverse, store, frame, prior, settings, normal, slope, cost, damping, iterations
):
    """Levenberg-Marquardt steps on the parameters, in place; return the new cost and damping.

    Args:
        parameters: Parameters of the chain; changed. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: See `_merge`.
        frame: Joint angles, features and weights of the newest frame, all 0 without one. Shapes (1, n), (1, m), (1, m).
        prior: Deviations of the joints' constraints, and variance of a feature. Shape (n,) and a number.
        settings: A `ChainSettings`.
        normal: Normal equations at the parameters; overwritten by later ones. Shape (N, N).
        slope: Gradient of the cost. Shape (N,).
        cost: Cost at the parameters.
        damping: Damping, relative to the diagonal of the normal equations.
        iterations: Largest number of steps.
    """
    excited, noise = prior
    size = parameters.shape[0]
    factor, step, trial = np.empty((size, size)), np.empty(size), np.empty(size)
    nothing, empty = np.zeros((0, 0)), np.zeros(0)
    for iteration in range(iterations):
        lower = np.inf
        if _factored(normal, damping, settings.least_pivot, factor):
            _descent(factor, slope, step)
            expected = 0.0
            for a in range(size):
                trial[a] = parameters[a] + step[a]
                expected -= 0.5 * slope[a] * step[a]
            if expected < settings.least_gain:
                break
            lower = _prior_cost(trial, excited, settings, nothing, empty)
            lower += _stored_terms(trial, reverse, store[0], store[1], store[2], noise, settings, nothing, empty)
            lower += _stored_terms(trial, reverse, frame[0], frame[1], frame[2], noise, settings, nothing, empty)
        if not lower < cost:
            damping = min(4.0 * damping, settings.largest_damping)
            continue
        gained = cost - lower
        cost = lower
        parameters[:] = trial
        damping = max(0.2 * damping, settings.least_damping)
        if gained < settings.small_gain:
            break
        if iteration + 1 < iterations:
            normal[:] = 0.0
            slope[:] = 0.0
            _prior_cost(parameters, excited, settings, normal, slope)
            _stored_terms(parameters, reverse, store[0], store[1], store[2], noise, settings, normal, slope)
            _stored_terms(parameters, reverse, frame[0], frame[1], frame[2], noise, settings, normal, slope)
    return cost, damping


@njit(cache=True, nogil=True)
def update_chains(memory, frame, settings, output):  # type: ignore[no-untyped-def]
    """Update the chains of all rows with their newest frames, and compute the features at present.

    Args:
        memory: A `ChainMemory` of arrays with a leading axis of rows; changed.
        frame: A `ChainFrame`.
        settings: A `ChainSettings`.
        output: A `ChainOutput`; written.
    """
    for row in range(frame.fresh.shape[0]):
        _update_row(memory, frame, settings, output, row)


@njit(cache=True, nogil=True)
def _update_row(memory, frame, settings, output, row):  # type: ignore[no-untyped-def]
    """Update one row, see `update_chains`."""
    n, m = frame.angles.shape[1], frame.features.shape[1]
    fresh = frame.fresh[row]
    if fresh and not memory.started[row]:
        memory.started[row] = True
        memory.origin[row] = frame.angles[row]
    store = (memory.angles[row], memory.features[row], memory.weights[row])
    newest = (np.zeros((1, n)), np.zeros((1, m)), np.zeros((1, m)))
    old = np.zeros(m, np.bool_)
    if fresh:
        _take_frame(memory, frame, settings, newest, old, row)
        _challenge(memory, settings, row)
    noise = memory.noise[row]
    excited = np.empty(n)
    _constraint_deviations(store[0], store[2], noise, settings, excited)
    before = _best(memory, row)
    size = memory.parameters.shape[2]
    normals, slope = np.zeros((2, size, size)), np.zeros(size)
    gap = memory.cost[row, 1 - before] - memory.cost[row, before]
    idle = _is_idle(memory, settings, row)
    for h in range(2):
        if h != before and idle:
            continue
        if memory.damping[row, h] == 0.0:
            memory.damping[row, h] = settings.first_damping
        parameters, normal, reverse = memory.parameters[row, h], normals[h], memory.reverse[row, h]
        slope[:] = 0.0
        cost = _prior_cost(parameters, excited, settings, normal, slope)
        cost += _stored_terms(parameters, reverse, store[0], store[1], store[2], noise, settings, normal, slope)
        if fresh:
            if h == before:
                _score(memory, frame, settings, output, normal, newest, old, row)
            cost += _stored_terms(parameters, reverse, newest[0], newest[1], newest[2], noise, settings, normal, slope)
        memory.cost[row, h], memory.damping[row, h] = _improve(
            parameters,
            reverse,
            store,
            newest,
            (excited, noise),
            settings,
            normal,
            slope,
            cost,
            memory.damping[row, h],
            settings.iterations if h == before or memory.challenge[row, 0] == 0.0 else 1,
        )
    if idle:
        memory.cost[row, 1 - before] = memory.cost[row, before] + gap
    best = _best(memory, row)
    if fresh:
        parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
        _follow_offsets(memory, frame, settings, newest, row)
        memory.scatter[row] += _store_frame(
            parameters, reverse, store, (newest[0][0], newest[1][0], frame.seen[row]), noise, settings
        )
        memory.noise[row] = _noise_of(parameters, reverse, store, memory.scatter[row], noise, settings)
        memory.frames[row] += 1.0
        linear, chained = memory.errors[row]
        serves = chained < settings.margin * linear
        if serves and memory.frames[row] > 2.0 * settings.memory:
            memory.least_error[row] = min(memory.least_error[row], chained)
        # Much worse than the linear filter, or than it was itself.
        failed = chained > settings.failed * min(linear, settings.failed * memory.least_error[row])
        memory.failures[row] = memory.failures[row] + 1.0 if failed else 0.0
        memory.served[row] += 1.0 if serves else 0.0
        # A chain that has never been good has not been bumped: it has too little data, or the arm is not rigid.
        if memory.failures[row] >= settings.patience and memory.served[row] >= settings.patience:
            _restart(memory, settings, row)
    output.best[row] = best
    output.chained[row] = memory.errors[row, 1] < settings.margin * memory.errors[row, 0]
    _present(memory, frame, settings, output, normals[best], row)


@njit(cache=True, nogil=True)
def _best(memory, row):  # type: ignore[no-untyped-def]
    """Return the index of the chain with the lower cost."""
    return 1 if memory.cost[row, 1] < memory.cost[row, 0] else 0


@njit(cache=True, nogil=True)
def _take_frame(memory, frame, settings, newest, old, row):  # type: ignore[no-untyped-def]
    """Write the newest frame, angles from the origin, as a keyframe; place points that it shows for the first time.

    Args:
        memory: A `ChainMemory`; changed.
        frame: A `ChainFrame`.
        settings: A `ChainSettings`.
        newest: Output: angles, features and weights, see `_improve`.
        old: Output: mask of the features of known points. Shape (m,).
        row: Row of the batch.
    """
    m = frame.features.shape[1]
    new = np.zeros(m, np.bool_)
    for k in range(frame.angles.shape[1]):
        newest[0][0, k] = frame.angles[row, k] - memory.origin[row, k]
    for i in range(m):
        seen, known = frame.seen[row, i], memory.known[row, i // 2]
        newest[1][0, i] = frame.features[row, i]
        newest[2][0, i] = 1.0 if seen else 0.0
        old[i] = seen and known
        new[i] = not known and frame.seen[row, i - i % 2] and frame.seen[row, i - i % 2 + 1]
    for h in range(2):
        reverse = memory.reverse[row, h]
        _place_points(memory.parameters[row, h], newest[0][0], reverse, settings.focal, newest[1][0], new)
    for j in range(m // 2):
        memory.known[row, j] = memory.known[row, j] or new[2 * j]


@njit(cache=True, nogil=True)
def _is_idle(memory, settings, row):  # type: ignore[no-untyped-def]
    """Return True if the worse chain is not fitted now: after two rounds of challenges it is fitted rarely."""
    rounds = 2.0 * (memory.origin.shape[1] + 3.0)
    return memory.challenge[row, 0] > rounds and memory.frames[row] % settings.rarely != 0.0


@njit(cache=True, nogil=True)
def _challenge(memory, settings, row):  # type: ignore[no-untyped-def]
    """Replace the worse chain, once it has lost, by another start of the fit: a way out of local minima."""
    if _is_idle(memory, settings, row):
        return
    challenge, best = memory.challenge[row], _best(memory, row)
    challenge[1] += 1.0
    # At first both orders gather frames.
    if challenge[1] < (settings.first_trial if challenge[0] == 0.0 else settings.trial):
        return
    joints, points = memory.origin.shape[1], memory.known.shape[1]
    kind = int(challenge[0]) % (joints + 3)
    parameters = memory.parameters[row, 1 - best]
    parameters[:] = memory.parameters[row, best]
    # Kinds 0 and 1 begin with nothing but the lines of sight of the points, 2 with the other order, the others leave
    # out one joint.
    other = kind == 1 or kind == 2
    memory.reverse[row, 1 - best] = memory.reverse[row, best] != other
    if kind < 2:
        parameters[: 6 * joints] = 0.0
        for j in range(points):
            at = 6 * joints + 3 * j
            depth = max(parameters[at + 2], LEAST_DEPTH)
            for i in range(3):
                parameters[at + i] = parameters[at + i] / depth if i < 2 else 1.0
        parameters[6 * joints + 3 * points :] = 0.0
    elif kind > 2:
        parameters[6 * (kind - 3) : 6 * (kind - 2)] = 0.0
    memory.damping[row, 1 - best] = settings.first_damping
    memory.cost[row, 1 - best] = np.inf
    challenge[0] += 1.0
    challenge[1] = 0.0


@njit(cache=True, nogil=True)
def _restart(memory, settings, row):  # type: ignore[no-untyped-def]
    """Forget all frames of a row, as after a bump; the joints' axes stay as a start."""
    best = _best(memory, row)
    memory.weights[row] = 0.0
    memory.known[row] = False
    memory.scatter[row], memory.frames[row] = 0.0, 0.0
    memory.failures[row], memory.served[row], memory.least_error[row] = 0.0, 0.0, settings.no_error
    memory.cost[row] = 0.0
    memory.challenge[row] = 0.0
    memory.reverse[row, 0], memory.reverse[row, 1] = False, True
    memory.parameters[row, 0] = memory.parameters[row, best]
    memory.parameters[row, 1] = memory.parameters[row, 0]
    memory.damping[row] = 0.0
    memory.offset[row] = 0.0
    memory.offset_variance[row] = 0.0
    memory.offset_power[row] = 0.0
    memory.residual_power[row] = memory.noise[row]
    memory.white[row] = memory.noise[row]


@njit(cache=True, nogil=True)
def _score(memory, frame, settings, output, normal, newest, old, row):  # type: ignore[no-untyped-def]
    """Score the prediction of a new frame by the chain so far, beside that of the linear filter."""
    n, m = frame.angles.shape[1], frame.features.shape[1]
    best = _best(memory, row)
    size = normal.shape[0]
    parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
    predicted, by_angles, derivatives = np.empty(m), np.empty((m, n)), np.zeros((m, size))
    chain_derivatives(parameters, newest[0][0], reverse, settings.focal, predicted, by_angles, derivatives)
    factor, columns = np.empty((size, size)), derivatives.T.copy()
    if _factored(normal, settings.least_damping, settings.least_pivot, factor):
        _whiten(factor, columns)
    fading = math.exp(-frame.duration[row] / settings.offset_time)
    squares, linear, both, used = 0.0, 0.0, 0, 0
    normalized, density, used = 0.0, 0.0, 0
    for i in range(m):
        if not old[i]:
            continue
        innovation = newest[1][0, i] - predicted[i] - fading * memory.offset[row, i]
        variance = memory.white[row] + memory.offset_variance[row, i]
        for a in range(size):
            variance += columns[a, i] ** 2
        normalized += innovation * innovation / variance
        density -= 0.5 * (innovation * innovation / variance + math.log(2.0 * math.pi * variance))
        used += 1
        if frame.compared[row, i]:
            squares += innovation * innovation
            linear += frame.linear_error[row, i] ** 2
            both += 1
    if used > 0:
        output.nis[row] = normalized / used
        output.log_likelihood[row] = density
    if both > 0:
        keep = 1.0 - 1.0 / settings.memory
        errors = memory.errors[row]
        errors[0] = keep * errors[0] + (1.0 - keep) * linear / both
        errors[1] = keep * errors[1] + (1.0 - keep) * squares / both


@njit(cache=True, nogil=True)
def _follow_offsets(memory, frame, settings, newest, row):  # type: ignore[no-untyped-def]
    """Filter what the chain leaves of the features: an offset of its own for each, with a decaying correlation.

    White noise has no offsets: their variance is the mean product of successive residuals, and the rest of the
    residuals' variance is white noise. Outliers are bounded.
    """
    m = frame.features.shape[1]
    residual = np.empty(m)
    best = _best(memory, row)
    parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
    _residuals(parameters, reverse, newest[0][0], newest[1][0], settings, residual)
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
    power = memory.offset_power[row] if memory.offset_power[row] > chance else 0.0
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
def _present(memory, frame, settings, output, normal, row):  # type: ignore[no-untyped-def]
    """Write features and Jacobian at the present posture, and their covariances."""
    n, m = frame.angles.shape[1], frame.features.shape[1]
    best = output.best[row]
    parameters = memory.parameters[row, best].copy()
    size = parameters.shape[0]
    theta = frame.present[row] - memory.origin[row]
    reverse, focal_unit = memory.reverse[row, best], settings.focal
    jacobian, derivatives = np.empty((m, n)), np.zeros((m, size))
    chain_derivatives(parameters, theta, reverse, focal_unit, output.features[row], jacobian, derivatives)
    columns, none = np.empty((size, m * n + m)), np.zeros((0, size))
    changed, ignored = np.empty((m, n)), np.empty(m)
    for a in range(size):
        kept = parameters[a]
        parameters[a] = kept + settings.difference
        chain_derivatives(parameters, theta, reverse, focal_unit, ignored, changed, none)
        parameters[a] = kept
        for i in range(m):
            for k in range(n):
                columns[a, i * n + k] = (changed[i, k] - jacobian[i, k]) / settings.difference
            columns[a, m * n + i] = derivatives[i, a]
    factor = np.empty((size, size))
    if _factored(normal, settings.least_damping, settings.least_pivot, factor):
        _whiten(factor, columns)
    for i in range(m):
        output.features[row, i] += memory.offset[row, i]
        total = memory.offset_variance[row, i]
        for a in range(size):
            total += columns[a, m * n + i] ** 2
        output.variance[row, i] = total
        covariance = output.covariance[row, i]
        covariance[:] = 0.0
        for a in range(size):
            part = columns[a, i * n : (i + 1) * n]
            for k in range(n):
                for j in range(n):
                    covariance[k, j] += part[k] * part[j]
        covariance[n, n] = settings.drift**2
        for k in range(n):
            # The differences have rounding errors.
            covariance[k, k] *= 1.0 + 1e-9
            output.jacobian[row, i, k] = jacobian[i, k]
