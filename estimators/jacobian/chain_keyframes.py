"""Keyframes of a rigid chain: postures with the mean features of all frames there, merged where they are near."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_equations import any_weight
from servotrack.estimators.jacobian.chain_kernel import chain_features, chain_pose


@njit(cache=True, nogil=True)
def chain_residuals(parameters, reverse, angles, features, settings, out):  # type: ignore[no-untyped-def]
    """Write features minus those of the chain. Shape (m,), px."""
    chain_features(parameters, angles, reverse, settings.focal, out)
    for i in range(out.shape[0]):
        out[i] = features[i] - out[i]


@njit(cache=True, nogil=True)
def place_points(parameters, angles, reverse, focal_unit, features, new):  # type: ignore[no-untyped-def]
    """Put points that are seen for the first time at depth 1 on their lines of sight."""
    n, p = angles.shape[0], features.shape[0] // 2
    pose = chain_pose(parameters, angles, reverse)
    tail = 6 * n + 3 * p
    focal = focal_unit * math.exp(parameters[tail])
    for j in range(p):
        if not new[2 * j]:
            continue
        x = (features[2 * j] - focal_unit * parameters[tail + 1]) / focal - pose[0][3]
        y = (features[2 * j + 1] - focal_unit * parameters[tail + 2]) / focal - pose[1][3]
        z = 1.0 - pose[2][3]
        for i in range(3):
            parameters[6 * n + 3 * j + i] = pose[0][i] * x + pose[1][i] * y + pose[2][i] * z


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
    chain_residuals(parameters, reverse, angles[into], features[into], settings, first)
    chain_residuals(parameters, reverse, angles[other], features[other], settings, second)
    share = weights[other].max() / (weights[into].max() + weights[other].max())
    for k in range(angles.shape[1]):
        angles[into, k] += share * (angles[other, k] - angles[into, k])
    chain_features(parameters, angles[into], reverse, settings.focal, mean)
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
        if not any_weight(weights[k]):
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
def store_frame(parameters, reverse, store, frame, noise, settings):  # type: ignore[no-untyped-def]
    """Put a frame into the store; return the squares that merging loses, and True if it shows little that is new.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: See `_merge`; changed.
        frame: Joint angles, features and their weights, 0 where they are not seen. Shapes (n,), (m,), (m,).
        noise: Variance of a feature, px^2.
        settings: A `ChainSettings`.
    """
    angles, features, weights = store
    theta, seen_at, seen = frame
    slot, squares = _free_slot(parameters, reverse, store, noise, settings)
    residual = np.empty(seen.shape[0])
    chain_residuals(parameters, reverse, theta, seen_at, settings, residual)
    for k in range(theta.shape[0]):
        angles[slot, k] = theta[k]
    for i in range(seen.shape[0]):
        features[slot, i] = seen_at[i]
        weights[slot, i] = 0.0
        if seen[i] > 0.0:
            # An outlier must not get weight by being merged.
            square = residual[i] * residual[i]
            trusted = 1.0 if square <= settings.outlier * noise else settings.outlier * noise / square
            weights[slot, i] = trusted * seen[i]
    if not any_weight(weights[slot]):
        return squares, True
    into, nearest = -1, settings.spacing
    for k in range(angles.shape[0]):
        if k != slot and any_weight(weights[k]):
            distance = _apart(angles, k, slot)
            if distance < nearest:
                into, nearest = k, distance
    if into >= 0:
        squares += _merge(parameters, reverse, store, into, slot, noise, settings)
    full = into >= 0
    for i in range(seen.shape[0]):
        full = full and (seen[i] <= 0.0 or weights[into, i] >= settings.enough)
    return squares, full


@njit(cache=True, nogil=True)
def noise_of(parameters, reverse, store, scatter, noise, settings, known):  # type: ignore[no-untyped-def]
    """Return the variance of a feature about the chain, from all frames.

    Args:
        parameters: Parameters of the chain. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: See `_merge`.
        scatter: Squares that merging has lost, px^2.
        noise: Variance of a feature so far, px^2.
        settings: A `ChainSettings`.
        known: Features of the chain that have been computed, and the joint angles of each row of them. Shapes (K, m)
            and (K, n).
    """
    angles, features, weights = store
    m = features.shape[1]
    residual = np.empty(m)
    squares, count, used = scatter, 0.0, 0.0
    for k in range(angles.shape[0]):
        if not any_weight(weights[k]):
            continue
        same = True
        for j in range(angles.shape[1]):
            same = same and known[1][k, j] == angles[k, j]
        if same:
            for i in range(m):
                residual[i] = features[k, i] - known[0][k, i]
        else:
            chain_residuals(parameters, reverse, angles[k], features[k], settings, residual)
        for i in range(m):
            if weights[k, i] > 0.0:
                # Each frame counts as in the fit.
                counted = 1.0 / (1.0 / weights[k, i] + 1.0 / settings.most_frames)
                squares += min(counted * residual[i] * residual[i], settings.outlier * noise)
                count += weights[k, i]
                used += 1.0
    # Parameters fit as many residuals of keyframes as they are; half of the residuals count in any case.
    free = max(count - min(float(parameters.shape[0]), 0.5 * used), 0.0)
    prior = 4.0
    return max((prior * settings.noise**2 + squares) / (prior + free), settings.least_noise**2)
