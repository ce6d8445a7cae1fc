"""Compiled step of a `ChainBank`. Rows of a batch come with K chains each: row r, chain k is at index r K + k."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.adaptive import filter_rows
from servotrack.estimators.jacobian.alignment import AlignmentState, Readings, align_rows
from servotrack.estimators.jacobian.chain_fit import copy_chain, update_row
from servotrack.estimators.jacobian.chain_records import ChainFrame, ChainMemory, ChainOutput
from servotrack.estimators.jacobian.chain_scores import foresee, write_present
from servotrack.estimators.jacobian.chain_target import restart_target
from servotrack.estimators.jacobian.contract import Increment
from servotrack.estimators.types import Array, Mask


class BankReadings(NamedTuple):
    """Rows of measurements, which all chains of a row share; `read_at` is the instant of the encoders' readings."""

    angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    read_at: Array
    time: Array


@njit(cache=True, nogil=True)
def step_bank(  # type: ignore[no-untyped-def]
    frames, rows, linear, seen, memory, readings, log_weight, frame_gears, row_gears, tuning, settings, weighting
):
    """Advance a bank by one measurement.

    Args:
        frames: See `_advance_rows`.
        rows: See `_advance_rows`.
        linear: See `_advance_rows`.
        seen: Fields of the `ChainState`s: `seen_joints`, `seen_features`, `seen_time`, `seen`, `jacobian`, `center` and
            `scale`, with a leading axis R.
        memory: `ChainMemory` with a leading axis R.
        readings: `BankReadings`.
        log_weight: Logarithms of the weights. Shape (rows, K).
        frame_gears: See `_advance_rows`.
        row_gears: See `_advance_rows`.
        tuning: Units and noise, see `filter_rows`.
        settings: A `ChainSettings`.
        weighting: Memory of the weights, and their floor.

    Returns:
        Fields of the new `AlignmentState`s of frames and features, and of the `AdaptiveFilter`; the new `seen_joints`,
        `seen_features`, `seen_time` and `seen`; the new `ChainMemory`; new logarithms of the weights; fields of the
        `ChainEstimate`, with a leading axis of rows.
    """
    aligned, single, filtered = _advance_rows(frames, rows, linear, readings, frame_gears, row_gears, tuning)
    foreseen = foresee(seen[0], seen[1], seen[4], aligned[4])
    new = _copied(memory)
    now_seen, weights, found = _update_bank(
        new, frames.seen, seen, aligned, foreseen, filtered[9:], readings.goal, log_weight, settings, weighting
    )
    return aligned[:8], single, filtered[:9], now_seen, new, weights, found


@njit(cache=True, nogil=True)
def _copied(memory):  # type: ignore[no-untyped-def]
    """Return a copy of a `ChainMemory`."""
    return ChainMemory(
        memory.started.copy(),
        memory.origin.copy(),
        memory.angles.copy(),
        memory.features.copy(),
        memory.weights.copy(),
        memory.scatter.copy(),
        memory.known.copy(),
        memory.parameters.copy(),
        memory.factor.copy(),
        memory.clock.copy(),
        memory.since.copy(),
        memory.damping.copy(),
        memory.cost.copy(),
        memory.reverse.copy(),
        memory.challenge.copy(),
        memory.noise.copy(),
        memory.offset.copy(),
        memory.offset_variance.copy(),
        memory.offset_power.copy(),
        memory.residual_power.copy(),
        memory.white.copy(),
        memory.residual.copy(),
        memory.recent.copy(),
        memory.errors.copy(),
        memory.failures.copy(),
        memory.served.copy(),
        memory.least_error.copy(),
        memory.frames.copy(),
        memory.moves.copy(),
        memory.motion.copy(),
        memory.motion_covariance.copy(),
        memory.evidence.copy(),
    )


@njit(cache=True, nogil=True)
def _advance_rows(frames, rows, linear, readings, frame_gears, row_gears, tuning):  # type: ignore[no-untyped-def]
    """Align frames and single features, and update the linear filters.

    Args:
        frames: `AlignmentState` of whole frames. Leading axis R = rows K.
        rows: `AlignmentState` of single features. Leading axes (R, m).
        linear: `AdaptiveFilter`. Leading axis R.
        readings: `BankReadings`.
        frame_gears: Mask of the joints that turn (n,), half of their play (K, n), and latency, for `frames`.
        row_gears: The same for `rows`, with half plays (K m, n).
        tuning: Units and noise, see `filter_rows`.

    Returns:
        Results of `align_rows` for the frames; the fields of the new `AlignmentState` of the features, with leading
        axes (R, m); results of `filter_rows`.
    """
    n, m = readings.angles.shape[1], readings.features.shape[1]
    count, total = frame_gears[1].shape[0], frames.seen.shape[0]
    angles, features, visible = np.empty((total, n)), np.zeros((total, 2 * m)), np.zeros(total, np.bool_)
    stamp, read_at, time = np.empty(total), np.empty(total), np.empty(total)
    each_angles, each_feature = np.empty((total * m, n)), np.zeros((total * m, 1))
    each_visible, each_stamp = np.empty(total * m, np.bool_), np.empty(total * m)
    each_read_at, each_time = np.empty(total * m), np.empty(total * m)
    for r in range(total):
        row = r // count
        angles[r] = readings.angles[row]
        stamp[r] = readings.frame_time[row] - frame_gears[2]
        read_at[r], time[r] = readings.read_at[row], readings.time[row]
        for i in range(m):
            at = r * m + i
            if readings.visible[row, i]:
                visible[r] = True
                features[r, i], features[r, m + i] = readings.features[row, i], 1.0
                each_feature[at, 0] = readings.features[row, i]
            each_angles[at] = readings.angles[row]
            each_visible[at] = readings.visible[row, i]
            each_stamp[at] = readings.frame_time[row] - row_gears[2]
            each_read_at[at], each_time[at] = readings.read_at[row], readings.time[row]
    aligned = align_rows(
        frames, Readings(angles, features, visible, stamp, read_at, time), frame_gears[0], frame_gears[1]
    )
    single = align_rows(
        _merged(rows),
        Readings(each_angles, each_feature, each_visible, each_stamp, each_read_at, each_time),
        row_gears[0],
        row_gears[1],
    )
    offset = single[5].reshape((total, m)).copy()
    for r in range(total):
        for i in range(m):
            offset[r, i] -= readings.goal[r // count, i]
    seen = single[2].reshape((total, m))
    increment = Increment(
        single[8].reshape((total, m, n)),
        single[9].reshape((total, m)),
        single[10].reshape((total, m, 1)),
        single[11].reshape((total, m)),
        single[12].reshape((total, m, n)),
        single[13].reshape((total, m)),
    )
    filtered = filter_rows(linear, increment, offset, seen, tuning[0], tuning[1])
    history, waiting = rows.history_time.shape[2], rows.waiting_time.shape[2]
    split = (
        single[0].reshape((total, m, history)),
        single[1].reshape((total, m, history, n)),
        seen,
        single[3].reshape((total, m)),
        single[4].reshape((total, m, n)),
        single[5].reshape((total, m, 1)),
        single[6].reshape((total, m, waiting)),
        single[7].reshape((total, m, waiting, 1)),
    )
    return aligned, split, filtered


@njit(cache=True, nogil=True)
def _merged(rows):  # type: ignore[no-untyped-def]
    """Merge both leading axes of an `AlignmentState`."""
    total, m, history, n = rows.history_angles.shape
    waiting = rows.waiting_time.shape[2]
    return AlignmentState(
        rows.history_time.reshape((total * m, history)),
        rows.history_angles.reshape((total * m, history, n)),
        rows.seen.reshape(total * m),
        rows.frame_time.reshape(total * m),
        rows.frame_joints.reshape((total * m, n)),
        rows.frame_features.reshape((total * m, 1)),
        rows.waiting_time.reshape((total * m, waiting)),
        rows.waiting_features.reshape((total * m, waiting, 1)),
    )


@njit(cache=True, nogil=True)
def _update_bank(  # type: ignore[no-untyped-def]
    memory, was_seen, before, aligned, foreseen, linear, goal, log_weight, settings, weighting
):
    """Update all chains, and compute the estimate of the best one of each row.

    Args:
        memory: `ChainMemory` with a leading axis R; changed.
        was_seen: `alignment.seen` of the `ChainState`s. Shape (R,).
        before: See `step_bank`.
        aligned: See `_advance_rows`.
        foreseen: Features that the linear filter foresees from the joints' motion. Shape (R, m), px.
        linear: Fields of the `LinearEstimate`, with a leading axis R.
        goal: Desired features. Shape (rows, m), px.
        log_weight: Logarithms of the weights. Shape (rows, K).
        settings: A `ChainSettings`.
        weighting: Memory of the weights, and their floor.

    Returns:
        New `seen_joints`, `seen_features`, `seen_time` and `seen`; new logarithms of the weights; fields of the
        `ChainEstimate`, with a leading axis of rows.
    """
    rows, count = log_weight.shape
    n, m = aligned[4].shape[1], goal.shape[1]
    frame, seen = _frames(was_seen, before, aligned, foreseen)
    size = memory.parameters.shape[2]
    output = ChainOutput(
        np.zeros((rows * count, m)),
        np.zeros((rows * count, m, n + 1)),
        np.zeros((rows * count, m, n + 1, n + 1)),
        np.zeros((rows * count, m)),
        np.zeros(rows * count),
        np.zeros(rows * count),
        np.zeros(rows * count, np.int64),
        np.zeros(rows * count, np.bool_),
        np.zeros((rows * count, size)),
    )
    weights = np.empty((rows, count))
    error, jacobian, covariance = np.empty((rows, m)), np.empty((rows, m, n + 1)), np.empty((rows, m, n + 1, n + 1))
    variance, log_likelihood, nis = np.empty((rows, m)), np.empty(rows), np.empty(rows)
    chained, parameters, reverse = np.empty((rows, m), np.bool_), np.empty((rows, size)), np.empty(rows, np.bool_)
    focal, angles = np.empty(rows), np.empty((rows, n))
    for row in range(rows):
        for k in range(count):
            r = row * count + k
            update_row(memory, frame, settings, output, r)
            if output.chained[r]:
                # Densities of features in px, as those of the linear filter.
                output.log_likelihood[r] -= np.sum(frame.seen[r]) * math.log(before[6][r])
            else:
                output.log_likelihood[r], output.nis[r] = linear[2][r], linear[3][r]
            weights[row, k] = weighting[0] * log_weight[row, k] + output.log_likelihood[r] / m
        for k in range(1, count):
            # By clocks of their own, which depend on the keyframes, several chains would be fitted in one frame.
            memory.clock[row * count + k, 0] = memory.clock[row * count, 0] + k * settings.refit / count
        _renew_failed(memory, row * count, count, weights[row], settings)
        k = _chosen(weights[row], memory, row * count, weighting[1])
        r = row * count + k
        best = output.best[r]
        write_present(memory, frame, settings, output, r)
        log_likelihood[row], nis[row] = output.log_likelihood[r], output.nis[r]
        parameters[row], reverse[row] = output.parameters[r], memory.reverse[r, best]
        scale = before[6][r]
        focal[row] = settings.focal * scale
        for j in range(n):
            angles[row, j] = frame.present[r, j] - memory.origin[r, j]
        for i in range(m):
            chained[row, i] = output.chained[r] and memory.known[r, i // 2]
            if chained[row, i]:
                error[row, i] = output.features[r, i] * scale + (before[5][r, i % 2] - goal[row, i])
                variance[row, i] = output.variance[r, i] * (scale * scale)
                jacobian[row, i] = output.jacobian[r, i] * scale
                covariance[row, i] = output.covariance[r, i] * (scale * scale)
            else:
                error[row, i], variance[row, i] = linear[0][r, i], linear[5][r, i]
                jacobian[row, i], covariance[row, i] = linear[1][r, i], linear[4][r, i]
    found = (error, jacobian, log_likelihood, nis, covariance, variance, chained, parameters, reverse, focal, angles)
    return seen, weights, found


@njit(cache=True, nogil=True)
def _renew_failed(memory, first, count, weights, settings):  # type: ignore[no-untyped-def]
    """Let chains with a moving target that have gone astray begin anew as the best chain at rest."""
    best = -1
    for k in range(count):
        if not memory.moves[first + k] and (best < 0 or weights[k] > weights[best]):
            best = k
    if best < 0:
        return
    for r in range(first, first + count):
        if memory.moves[r] and memory.failures[r] >= settings.patience:
            copy_chain(memory, r, first + best)
            restart_target(memory, settings, r)


@njit(cache=True, nogil=True)
def _chosen(weights, memory, first, floor):  # type: ignore[no-untyped-def]
    """Normalize logarithms of weights, among chains at rest and among those that move, and return the chosen index."""
    rest = 0
    while rest < weights.shape[0] and not memory.moves[first + rest]:
        rest += 1
    if rest == weights.shape[0]:
        return _normalize(weights, floor)
    moving = rest + _normalize(weights[rest:], floor)
    if rest == 0:
        return moving
    still = _normalize(weights[:rest], floor)
    return moving if memory.evidence[first + moving] > memory.evidence[first + still] else still


@njit(cache=True, nogil=True)
def _normalize(weights, floor):  # type: ignore[no-untyped-def]
    """Subtract the largest of some logarithms from all, bound them, and return its index; NaN counts as the largest."""
    best = 0
    for k in range(1, weights.shape[0]):
        if weights[best] == weights[best] and not weights[k] <= weights[best]:
            best = k
    top = weights[best]
    for k in range(weights.shape[0]):
        weights[k] -= top
        if weights[k] < floor:
            weights[k] = floor
    return best


@njit(cache=True, nogil=True)
def _frames(was_seen, before, aligned, foreseen):  # type: ignore[no-untyped-def]
    """Return the `ChainFrame`, and when each feature was last seen, see `ChainState`: joints, features, time, mask."""
    joints, features, times, known, jacobian, center, scale = before
    seen, frame_time, frame_joints, frame_features = aligned[2], aligned[3], aligned[4], aligned[5]
    total, m, n = joints.shape
    joints, features, times, known = joints.copy(), features.copy(), times.copy(), known.copy()
    fresh, shown, compared = np.empty(total, np.bool_), np.zeros((total, m), np.bool_), np.zeros((total, m), np.bool_)
    centered, linear_error = np.zeros((total, m)), np.empty((total, m))
    for r in range(total):
        fresh[r] = aligned[11][r] or (seen[r] and not was_seen[r])
        for i in range(m):
            expected = foreseen[r, i] + jacobian[r, i, n] * (frame_time[r] - times[r, i])
            linear_error[r, i] = (frame_features[r, i] - expected) / scale[r]
            if fresh[r] and frame_features[r, m + i] > 0.5:
                shown[r, i], compared[r, i] = True, known[r, i]
                centered[r, i] = (frame_features[r, i] - center[r, i % 2]) / scale[r]
                joints[r, i], features[r, i] = frame_joints[r], frame_features[r, i]
                times[r, i], known[r, i] = frame_time[r], True
    present = frame_joints + aligned[12]
    frame = ChainFrame(fresh, frame_joints, centered, shown, aligned[9], linear_error, compared, present, aligned[13])
    return frame, (joints, features, times, known)
