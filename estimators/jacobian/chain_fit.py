"""Compiled fit of a rigid chain to frames: Levenberg-Marquardt over keyframes, and comparison of both orders.

Each row of a batch has keyframes and two chains, in the order of the joints and in reverse. The worse one is replaced
by other starts of the fit, a way out of local minima.
"""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_equations import (
    any_weight,
    constraint_deviations,
    descent,
    factored,
    prior_cost,
    row_terms,
    stored_terms,
    unwhiten,
)
from servotrack.estimators.jacobian.chain_kernel import LEAST_DEPTH
from servotrack.estimators.jacobian.chain_keyframes import chain_residuals, noise_of, place_points, store_frame
from servotrack.estimators.jacobian.chain_scores import (
    better_chain,
    follow_offsets,
    score_frame,
    write_present,
)
from servotrack.estimators.jacobian.chain_target import (
    eliminate,
    forecast_target,
    place_target,
    restart_target,
)


@njit(cache=True, nogil=True)
def _improve(  # type: ignore[no-untyped-def]
    parameters, reverse, store, frame, prior, settings, normal, slope, start, iterations, predicted, factor
):
    """Levenberg-Marquardt steps on the parameters, in place; return the new cost and damping.

    The third value is true if `factor` is that of `normal` with the least damping.

    Args:
        parameters: Parameters of the chain; changed. Shape (N,).
        reverse: True if the last joint is next to the camera.
        store: See `_merge`.
        frame: Joint angles, features and weights of the newest frame, all 0 without one. Shapes (1, n), (1, m), (1, m).
        prior: Deviations of the joints' constraints, and variance of a feature. Shape (n,) and a number.
        settings: A `ChainSettings`.
        normal: Normal equations at the parameters; overwritten by later ones. Shape (N, N).
        slope: Gradient of the cost. Shape (N,).
        start: Cost at the parameters, and damping, relative to the diagonal of the normal equations.
        iterations: Largest number of steps.
        predicted: Features of the chain at the keyframes; changed with the parameters. Shape (K, m), px.
        factor: Overwritten. Shape (N, N).
    """
    (excited, noise), (cost, damping) = prior, start
    size = parameters.shape[0]
    step, trial, ready = np.empty(size), np.empty(size), False
    nothing, empty = np.zeros((0, 0)), np.zeros(0)
    tried, newest = np.empty(predicted.shape), np.empty(frame[1].shape)
    for iteration in range(iterations):
        lower, ready = np.inf, False
        if factored(normal, damping, settings.least_pivot, factor):
            ready = damping == settings.least_damping
            descent(factor, slope, step)
            expected = 0.0
            for a in range(size):
                trial[a] = parameters[a] + step[a]
                expected -= 0.5 * slope[a] * step[a]
            if expected < settings.least_gain:
                break
            lower = prior_cost(trial, excited, settings, nothing, empty)
            lower += stored_terms(trial, reverse, store[0], store[1], store[2], noise, settings, nothing, empty, tried)
            lower += stored_terms(trial, reverse, frame[0], frame[1], frame[2], noise, settings, nothing, empty, newest)
        if not lower < cost:
            damping = min(4.0 * damping, settings.largest_damping)
            continue
        gained = cost - lower
        cost = lower
        parameters[:] = trial
        predicted[:] = tried
        damping = max(0.2 * damping, settings.least_damping)
        if gained < settings.small_gain:
            break
        if iteration + 1 < iterations:
            normal[:] = 0.0
            slope[:] = 0.0
            prior_cost(parameters, excited, settings, normal, slope)
            stored_terms(parameters, reverse, store[0], store[1], store[2], noise, settings, normal, slope, tried)
            stored_terms(parameters, reverse, frame[0], frame[1], frame[2], noise, settings, normal, slope, newest)
    return cost, damping, ready


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
        update_row(memory, frame, settings, output, row)
        write_present(memory, frame, settings, output, row)


@njit(cache=True, nogil=True)
def update_row(memory, frame, settings, output, row):  # type: ignore[no-untyped-def]
    """Update one row, see `update_chains`.

    The first frames are fitted as they come. Later ones change little: both chains of a row take turns to be fitted to
    all keyframes, and the frames between correct the last fit.
    """
    n, m, size = frame.angles.shape[1], frame.features.shape[1], memory.parameters.shape[2]
    fresh = frame.fresh[row]
    if fresh and not memory.started[row]:
        memory.started[row] = True
        memory.origin[row] = frame.angles[row]
        restart_target(memory, settings, row)
    store = (memory.angles[row], memory.features[row], memory.weights[row])
    newest = (np.zeros((1, n)), np.zeros((1, m)), np.zeros((1, m)))
    old = np.zeros(m, np.bool_)
    placed = False
    if fresh:
        placed = _take_frame(memory, frame, settings, newest, old, row)
    eager = placed or memory.frames[row] < settings.eager
    due, challenged = _take_turn(memory, settings, row) if fresh else (False, False)
    if eager:
        due, challenged = True, False
    if fresh and (eager or challenged):
        _challenge(memory, settings, eager, row)
    before = better_chain(memory, row)
    idle = _is_idle(memory, settings, row) if eager else not challenged
    excited, count = np.empty(n), store[0].shape[0]
    fits = due or not idle
    # Most frames of an arm at rest need no room for normal equations.
    side = size if fits else 0
    normals, factors, slope = np.empty((2, side, side)), np.empty((2, side, side)), np.empty(size)
    predicted, ready = np.empty((2, count, m)), False
    if fits:
        constraint_deviations(store[0], store[2], memory.noise[row], settings, excited)
    if fresh:
        if memory.frames[row] == 0.0:
            parameters, reverse = memory.parameters[row, before], memory.reverse[row, before]
            frames = (store[0], store[1], store[2], memory.noise[row])
            _sum_terms(parameters, reverse, excited, frames, settings, normals[0], slope, predicted[0])
            _keep_factor(memory, settings, normals[0], row)
        columns = score_frame(memory, frame, settings, output, newest, old, row)
        if not due:
            _correct(memory, newest, columns, memory.since[row] + 1.0, settings, row, before)
    prior = (excited, memory.noise[row])
    gap = memory.cost[row, 1 - before] - memory.cost[row, before]
    # Near its optimum, one step is enough; it is what the next frames begin with.
    iterations = settings.iterations if eager else 1
    if due:
        work = (normals[before], factors[before], slope, predicted[before])
        ready = _fit(memory, store, newest, prior, settings, work, iterations, row, before)
    if idle:
        memory.cost[row, 1 - before] = memory.cost[row, before] + gap
    else:
        h, iterations = 1 - before, 1 if eager and memory.challenge[row, 0] > 0.0 else settings.iterations
        work = (normals[h], factors[h], slope, predicted[h])
        also = _fit(memory, store, newest, prior, settings, work, iterations, row, h)
        # Each frame since the last fit has added less than this to the cost.
        added = m * (memory.since[row] + 1.0)
        if not due and memory.cost[row, h] < memory.cost[row, before] + added:
            memory.cost[row, before] = _cost(memory, store, newest, prior, settings, predicted[before], row, before)
        ready = ready if better_chain(memory, row) == before else also
    best = better_chain(memory, row)
    fitted = due if best == before else not idle
    if ready:
        for a in range(size):
            for b in range(a + 1):
                memory.factor[row, a, b] = factors[best, a, b]
    elif fitted:
        _keep_factor(memory, settings, normals[best], row)
    if fresh:
        memory.since[row] = 0.0 if fitted else memory.since[row] + 1.0
        _store_newest(memory, frame, settings, newest, predicted[best], fitted, row)
    output.best[row] = best
    output.chained[row] = memory.errors[row, 1] < settings.margin * memory.errors[row, 0]


@njit(cache=True, nogil=True)
def _take_turn(memory, settings, row):  # type: ignore[no-untyped-def]
    """Return True for the better chain of a row if it is its turn to be fitted, and True for its challenger."""
    clock = memory.clock[row]
    turn = np.floor(clock[0] / settings.refit)
    if turn == clock[1]:
        return False, False
    clock[1] = turn
    own = turn % settings.own_share == 0.0
    return own, not own


@njit(cache=True, nogil=True)
def _correct(memory, newest, columns, frames, settings, row, h):  # type: ignore[no-untyped-def]
    """Correct a chain of a row by its newest frame alone, with the normal equations of the last fit.

    It is the first step of a fit to all frames from the optimum for all but the newest: the update of an extended
    Kalman filter. Frames since the last fit count as frames at the same posture.

    Args:
        memory: A `ChainMemory`; changed.
        newest: See `_improve`.
        columns: Whitened derivatives of the features by the parameters. Shape (N, m).
        frames: Number of frames since the last fit, this one included.
        settings: A `ChainSettings`.
        row: Row of the batch.
        h: Index of the chain.
    """
    parameters, factor = memory.parameters[row, h], memory.factor[row]
    size, m = columns.shape
    residual = np.empty(m)
    chain_residuals(parameters, memory.reverse[row, h], newest[0][0], newest[1][0], settings, residual)
    index = np.flatnonzero(newest[2][0])
    count = len(index)
    total, right = np.zeros((count, count)), np.empty((count, 1))
    for c in range(count):
        i = index[c]
        right[c, 0] = residual[i]
        for d in range(c + 1):
            for a in range(size):
                total[c, d] += frames * columns[a, i] * columns[a, index[d]]
            total[d, c] = total[c, d]
        total[c, c] += 1.0 / row_terms(residual[i], newest[2][0, i], memory.noise[row], settings)[1]
    eliminate(total, right)
    step = np.zeros(size)
    for c in range(count):
        for a in range(size):
            step[a] += columns[a, index[c]] * right[c, 0]
    unwhiten(factor, step)
    for a in range(size):
        parameters[a] += step[a]


@njit(cache=True, nogil=True)
def _keep_factor(memory, settings, normal, row):  # type: ignore[no-untyped-def]
    """Factor normal equations, for the covariances of predictions until the next fit; the identity if that fails."""
    factor = memory.factor[row]
    if not factored(normal, settings.least_damping, settings.least_pivot, factor):
        factor[:] = np.eye(factor.shape[0])


@njit(cache=True, nogil=True)
def _sum_terms(parameters, reverse, excited, frames, settings, normal, slope, predicted):  # type: ignore[no-untyped-def]
    """Write the normal equations of prior and frames, unless they are empty, and return their cost."""
    normal[:] = 0.0
    slope[:] = 0.0
    cost = prior_cost(parameters, excited, settings, normal, slope)
    angles, features, weights, noise = frames
    return cost + stored_terms(
        parameters, reverse, angles, features, weights, noise, settings, normal, slope, predicted
    )


@njit(cache=True, nogil=True)
def _cost(memory, store, newest, prior, settings, predicted, row, h):  # type: ignore[no-untyped-def]
    """Return the cost of a chain of a row at its parameters. Arguments as in `_fit`."""
    parameters, reverse = memory.parameters[row, h], memory.reverse[row, h]
    nothing, empty = np.zeros((0, 0)), np.zeros(0)
    frames = (store[0], store[1], store[2], prior[1])
    cost = _sum_terms(parameters, reverse, prior[0], frames, settings, nothing, empty, predicted)
    new = np.empty(newest[1].shape)
    return cost + stored_terms(
        parameters, reverse, newest[0], newest[1], newest[2], prior[1], settings, nothing, empty, new
    )


@njit(cache=True, nogil=True)
def _fit(  # type: ignore[no-untyped-def]
    memory, store, newest, prior, settings, work, iterations, row, h
):
    """Fit a chain of a row to its keyframes and the newest frame, and write its cost and damping.

    Returns True if the factor is that of the normal equations with the least damping.

    Args:
        memory: A `ChainMemory`; changed.
        store: See `_merge`.
        newest: See `_improve`.
        prior: See `_improve`.
        settings: A `ChainSettings`.
        work: Outputs: normal equations at the parameters before the last step (N, N), their factor (N, N), gradient
            (N,), and features of the chain at the keyframes (K, m), px.
        iterations: Largest number of steps.
        row: Row of the batch.
        h: Index of the chain.
    """
    if memory.damping[row, h] == 0.0:
        memory.damping[row, h] = settings.first_damping
    parameters, reverse, new = memory.parameters[row, h], memory.reverse[row, h], np.empty(newest[1].shape)
    frames, (normal, factor, slope, predicted) = (store[0], store[1], store[2], prior[1]), work
    cost = _sum_terms(parameters, reverse, prior[0], frames, settings, normal, slope, predicted)
    cost += stored_terms(parameters, reverse, newest[0], newest[1], newest[2], prior[1], settings, normal, slope, new)
    memory.cost[row, h], memory.damping[row, h], ready = _improve(
        parameters,
        reverse,
        store,
        newest,
        prior,
        settings,
        normal,
        slope,
        (cost, memory.damping[row, h]),
        iterations,
        predicted,
        factor,
    )
    return ready


@njit(cache=True, nogil=True)
def _store_newest(memory, frame, settings, newest, predicted, fitted, row):  # type: ignore[no-untyped-def]
    """Put the newest frame into the store, and judge the chain by its errors so far.

    Args:
        memory: A `ChainMemory`; changed.
        frame: A `ChainFrame`.
        settings: A `ChainSettings`.
        newest: See `_improve`.
        predicted: Features of the better chain at the keyframes before, if it is `fitted`. Shape (K, m), px.
        fitted: True if the better chain has been fitted to this frame.
        row: Row of the batch.
    """
    store, noise = (memory.angles[row], memory.features[row], memory.weights[row]), memory.noise[row]
    best = better_chain(memory, row)
    parameters, reverse = memory.parameters[row, best], memory.reverse[row, best]
    known_at = np.full(store[0].shape, np.nan)
    if fitted:
        for k in range(len(known_at)):
            if any_weight(store[2][k]):
                known_at[k] = store[0][k]
    follow_offsets(memory, frame, settings, newest, row)
    newest_frame = (newest[0][0], newest[1][0], newest[2][0])
    lost, full = store_frame(parameters, reverse, store, newest_frame, noise, settings)
    memory.scatter[row] += lost
    memory.clock[row, 0] += settings.resting if full else 1.0
    if fitted:
        computed = (predicted, known_at)
        memory.noise[row] = noise_of(parameters, reverse, store, memory.scatter[row], noise, settings, computed)
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


@njit(cache=True, nogil=True)
def _take_frame(memory, frame, settings, newest, old, row):  # type: ignore[no-untyped-def]
    """Write the newest frame, angles from the origin, as a keyframe; place points that it shows for the first time.

    Return True if there are such points.

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
    if memory.moves[row]:
        forecast_target(memory, frame.duration[row], settings, row)
    for h in range(2):
        reverse = memory.reverse[row, h]
        place_points(memory.parameters[row, h], newest[0][0], reverse, settings.focal, newest[1][0], new)
        if memory.moves[row]:
            place_target(memory.parameters[row, h], frame.angles.shape[1], memory.motion[row], new)
    placed = False
    for j in range(m // 2):
        placed = placed or new[2 * j]
        memory.known[row, j] = memory.known[row, j] or new[2 * j]
    return placed


@njit(cache=True, nogil=True)
def _is_idle(memory, settings, row):  # type: ignore[no-untyped-def]
    """Return True if the worse chain is not fitted now: after two rounds of challenges it is fitted rarely."""
    rounds = 2.0 * (memory.origin.shape[1] + 3.0)
    return memory.challenge[row, 0] > rounds and memory.frames[row] % settings.rarely != 0.0


@njit(cache=True, nogil=True)
def _challenge(memory, settings, eager, row):  # type: ignore[no-untyped-def]
    """Replace the worse chain, once it has lost, by another start of the fit: a way out of local minima.

    Args:
        memory: A `ChainMemory`; changed.
        settings: A `ChainSettings`.
        eager: True if all frames are fitted as they come.
        row: Row of the batch.
    """
    if eager and _is_idle(memory, settings, row):
        return
    challenge, best = memory.challenge[row], better_chain(memory, row)
    challenge[1] += 1.0 if eager else float(settings.iterations)
    # A challenger that has come to where the better chain is has lost at once. At first both orders gather frames.
    apart = memory.cost[row, 1 - best] - memory.cost[row, best]
    same = not eager and apart < settings.small_gain
    if not same and challenge[1] < (settings.first_trial if challenge[0] == 0.0 else settings.trial):
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
    best = better_chain(memory, row)
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
    memory.recent[row] = 0.0
    memory.residual_power[row] = memory.noise[row]
    memory.white[row] = memory.noise[row]
    restart_target(memory, settings, row)


@njit(cache=True, nogil=True)
def copy_chain(memory, to, origin):  # type: ignore[no-untyped-def]
    """Copy what a row knows, but for the motion of its target, to another row."""
    memory.angles[to] = memory.angles[origin]
    memory.features[to] = memory.features[origin]
    memory.weights[to] = memory.weights[origin]
    memory.scatter[to] = memory.scatter[origin]
    memory.known[to] = memory.known[origin]
    memory.parameters[to] = memory.parameters[origin]
    memory.factor[to] = memory.factor[origin]
    memory.since[to] = memory.since[origin]
    memory.damping[to] = memory.damping[origin]
    memory.cost[to] = memory.cost[origin]
    memory.reverse[to] = memory.reverse[origin]
    memory.challenge[to] = memory.challenge[origin]
    memory.noise[to] = memory.noise[origin]
    memory.offset[to] = memory.offset[origin]
    memory.offset_variance[to] = memory.offset_variance[origin]
    memory.offset_power[to] = memory.offset_power[origin]
    memory.residual_power[to] = memory.residual_power[origin]
    memory.white[to] = memory.white[origin]
    memory.residual[to] = memory.residual[origin]
    memory.recent[to] = memory.recent[origin]
    memory.errors[to] = memory.errors[origin]
    memory.served[to] = memory.served[origin]
    memory.least_error[to] = memory.least_error[origin]
    memory.frames[to] = memory.frames[origin]
    memory.evidence[to] = memory.evidence[origin]
    memory.failures[to] = 0.0
