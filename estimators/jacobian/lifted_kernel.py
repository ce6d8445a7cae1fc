"""Compiled recursion of the lifted Kalman filter: interacting multiple models over a five-dimensional complex state.

Plane vectors are complex numbers u + iv here: every quantity of the filter turns and scales but never shears, so its
mean is a complex vector, its covariance Hermitian, and half the work of the real form is gone.

A row of the batch holds M models of the target (see `TargetModel`). Within each, the noise of a
feature is a mixture over L standard deviations, whose weights are learned, and an outlier of fixed probability. All
branches of one model share the direction of the gain, so that collapsing them to their exact mean and covariance
costs nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

STATE_SIZE = 5
"""Target A, its velocity V and acceleration G, elbow B, tool minus elbow D; px, px/s, px/s^2, px, px."""
CANCELED = 1e-11
"""A measurement that leaves less than this share of a variance has left nothing but rounding."""
ROUNDED = 1e-6
"""Below this share, rounding shows in the correlations that are left."""
ROUNDING = 4e-12
"""Of a difference, relative to what it was taken from."""


@njit(cache=True, nogil=True)
def _mix(mean, cov, weight, stay, mixed_mean, mixed_cov, predicted):  # type: ignore[no-untyped-def]
    """Interaction (Blom and Bar-Shalom 1988): what each model believes after the others may have switched to it.

    All switches being equally likely, model j is a mixture of itself and of everybody: one pass over the models makes
    everybody's moments, about their common mean so that nothing cancels, and a second one each model's own.
    """
    models = weight.shape[0]
    leave = (1.0 - stay) / (models - 1) if models > 1 else 0.0
    own = stay - leave if models > 1 else 1.0
    center = np.zeros(STATE_SIZE, dtype=np.complex128)
    everybody = np.zeros((STATE_SIZE, STATE_SIZE), dtype=np.complex128)
    for i in range(models):
        for r in range(STATE_SIZE):
            center[r] += weight[i] * mean[i, r]
    for i in range(models):
        for r in range(STATE_SIZE):
            for c in range(r + 1):
                spread = (mean[i, r] - center[r]) * np.conj(mean[i, c] - center[c])
                mixed_cov[i, r, c] = cov[i, r, c] + spread
                everybody[r, c] += weight[i] * mixed_cov[i, r, c]
    for j in range(models):
        predicted[j] = own * weight[j] + leave
        from_own, from_all = own * weight[j] / predicted[j], leave / predicted[j]
        for r in range(STATE_SIZE):
            mixed_mean[j, r] = center[r] + from_own * (mean[j, r] - center[r])
        for r in range(STATE_SIZE):
            for c in range(r + 1):
                shift = (mixed_mean[j, r] - center[r]) * np.conj(mixed_mean[j, c] - center[c])
                mixed_cov[j, r, c] = from_own * mixed_cov[j, r, c] + from_all * everybody[r, c] - shift
                mixed_cov[j, c, r] = np.conj(mixed_cov[j, r, c])


@njit(cache=True, nogil=True)
def _predict(mean, cov, dt, model, drift):  # type: ignore[no-untyped-def]
    """Move one model's target for `dt`: V' = G + white acceleration, G' = -recall V - damping G + white jerk."""
    jerk, jump, recall, damping = model[0], model[1], model[2], model[3]
    dt2 = dt * dt
    half = 0.5 * dt2
    if damping > 0.0:
        keep = math.exp(-damping * dt)
        gain = (1.0 - keep) / damping
        lift = (dt - gain) / damping
    else:
        keep, gain, lift = 1.0, dt, half
    swing = 1.0 - half * recall
    pull = recall * gain
    mean[0] += dt * mean[1] + lift * mean[2]
    mean[1], mean[2] = swing * mean[1] + gain * mean[2], -pull * mean[1] + keep * swing * mean[2]
    for c in range(STATE_SIZE):
        cov[0, c] += dt * cov[1, c] + lift * cov[2, c]
        velocity = cov[1, c]
        cov[1, c] = swing * velocity + gain * cov[2, c]
        cov[2, c] = keep * swing * cov[2, c] - pull * velocity
    for r in range(STATE_SIZE):
        cov[r, 0] += dt * cov[r, 1] + lift * cov[r, 2]
        velocity = cov[r, 1]
        cov[r, 1] = swing * velocity + gain * cov[r, 2]
        cov[r, 2] = keep * swing * cov[r, 2] - pull * velocity
    cov[0, 0] += dt * dt2 * (jerk * dt2 / 20.0 + jump / 3.0) + drift * dt
    position_velocity = dt2 * (jerk * dt2 / 8.0 + jump / 2.0)
    cov[0, 1] += position_velocity
    cov[1, 0] += position_velocity
    cov[0, 2] += jerk * dt * dt2 / 6.0
    cov[2, 0] += jerk * dt * dt2 / 6.0
    cov[1, 1] += dt * (jerk * dt2 / 3.0 + jump)
    cov[1, 2] += jerk * half
    cov[2, 1] += jerk * half
    cov[2, 2] += jerk * dt
    cov[3, 3] += drift * dt
    cov[4, 4] += drift * dt


@njit(cache=True, nogil=True)
def _correct(mean, cov, turn, swing, z, extra, noise, noise_weight, outlier_rate, outlier_variance, branch):  # type: ignore[no-untyped-def]
    """Fold z = turn A - swing B - D + noise into one model; exact moments over all noise branches.

    `branch` (L + 1,) receives the joint density of the measurement and each branch. Returns the density of the
    measurement, the squared innovation over its covariance, expected over the branches, and the share of the
    innovation that the encoders' noise explains.
    """
    g = np.empty(STATE_SIZE, dtype=np.complex128)
    turn_c, swing_c = np.conj(turn), np.conj(swing)
    for s in range(STATE_SIZE):
        g[s] = cov[s, 0] * turn_c - cov[s, 3] * swing_c - cov[s, 4]
    innovation = z - (turn * mean[0] - swing * mean[3] - mean[4])
    spread = max((turn * g[0] - swing * g[3] - g[4]).real, 0.0)
    nu2 = innovation.real * innovation.real + innovation.imag * innovation.imag
    # Joint uncertainty turns arm vectors, residual optics scales the error: both grow with what they act on.
    a, b = turn * mean[0], swing * mean[3]
    error = a - b - mean[4]
    arms = a.real * a.real + a.imag * a.imag + (a - b).real ** 2 + (a - b).imag ** 2
    by_joints = extra[0] * arms
    base = by_joints + extra[1] * (error.real * error.real + error.imag * error.imag)
    levels = noise.shape[0]
    density, expected = 0.0, 0.0
    for k in range(levels):
        variance = spread + base + noise[k]
        branch[k] = (
            (1.0 - outlier_rate) * noise_weight[k] * math.exp(-min(nu2 / variance, 600.0)) / (math.pi * variance)
        )
        density += branch[k]
        expected += noise_weight[k] * noise[k]
    variance = spread + base + expected + outlier_variance
    branch[levels] = outlier_rate * math.exp(-min(nu2 / variance, 600.0)) / (math.pi * variance)
    density = max(density + branch[levels], 1e-300)
    first, second = 0.0, 0.0
    for k in range(levels + 1):
        variance = spread + base + (noise[k] if k < levels else expected + outlier_variance)
        first += branch[k] / density / variance
        second += branch[k] / density / (variance * variance)
    shrink = nu2 * max(second - first * first, 0.0) - first
    before, trust = np.empty(STATE_SIZE), np.ones(STATE_SIZE)
    for r in range(STATE_SIZE):
        mean[r] += g[r] * innovation * first
        before[r] = cov[r, r].real
        for c in range(r + 1):
            cov[r, c] += shrink * g[r] * np.conj(g[c])
            cov[c, r] = np.conj(cov[r, c])
        cov[r, r] = complex(max(cov[r, r].real, CANCELED * before[r], 1e-12), 0.0)
        share = cov[r, r].real / before[r] if before[r] > 0.0 else 1.0
        if share < ROUNDED:
            # What is left of correlations is mixed with the rounding of what was taken off: they are trusted less.
            trust[r] = math.sqrt(max(1.0 - ROUNDING / share, 0.0))
    if trust.min() < 1.0:
        for r in range(STATE_SIZE):
            for c in range(r):
                cov[r, c] *= trust[r] * trust[c]
                cov[c, r] = np.conj(cov[r, c])
    return density, nu2 * first, by_joints * first * innovation


@njit(cache=True, nogil=True)
def lifted_update(  # type: ignore[no-untyped-def]
    mean, cov, weight, noise_weight, fresh, dt, joints, z,
    models, drift, stay, noise, noise_stay, extra, outlier_rate, outlier_variance,
    log_likelihood, surprise, encoder_error,
):  # fmt: skip
    """Advance every fresh row by `dt` and fold its measurement in; all arrays are changed in place.

    Args:
        mean: Shape (rows, M, 5), complex.
        cov: Shape (rows, M, 5, 5), complex.
        weight: Probabilities of the models. Shape (rows, M).
        noise_weight: Probabilities of the noise levels. Shape (rows, L).
        fresh: Rows with a new frame. Shape (rows,), bool.
        dt: Time since the state's instant. Shape (rows,), s.
        joints: Joint angles at the frame. Shape (rows, 2), rad.
        z: Features minus goal, u + iv. Shape (rows,), px.
        models: Spectral densities of white jerk, px^2/s^5, and white acceleration, px^2/s^3; recall, 1/s^2; damping,
            1/s. Shape (M, 4).
        drift: Random walk of A, B and D, px^2/s.
        stay: Probability to keep the model from frame to frame.
        noise: Variances of the noise levels. Shape (L,), px^2.
        noise_stay: Probability to keep the noise level from frame to frame.
        extra: Encoder variance, rad^2, and squared relative error of the optics. Shape (2,).
        outlier_rate: Probability of an outlier.
        outlier_variance: Variance it adds, px^2.
        log_likelihood: Result. Shape (rows,).
        surprise: Result: the squared innovation over its covariance, expected over all branches. Shape (rows,).
        encoder_error: Result: what the encoders' noise at the frame probably adds to the image, u + iv. Shape
            (rows,), px.
    """
    rows, count = weight.shape
    levels = noise.shape[0]
    mixed_mean, mixed_cov = np.empty_like(mean[0]), np.empty_like(cov[0])
    predicted, noise_prior, noise_post = np.empty(count), np.empty(levels), np.empty(levels)
    branch = np.empty(levels + 1)
    for n in range(rows):
        log_likelihood[n], surprise[n], encoder_error[n] = 0.0, 0.0, 0.0 + 0.0j
        if not fresh[n]:
            continue
        swing = complex(math.cos(joints[n, 1]), math.sin(joints[n, 1]))
        angle = joints[n, 0] + joints[n, 1]
        turn = complex(math.cos(angle), math.sin(angle))
        _mix(mean[n], cov[n], weight[n], stay, mixed_mean, mixed_cov, predicted)
        for k in range(levels):
            noise_prior[k] = noise_stay * noise_weight[n, k] + (1.0 - noise_stay) / levels
            noise_post[k] = 0.0
        total, misread = 0.0, 0.0 + 0.0j
        for j in range(count):
            _predict(mixed_mean[j], mixed_cov[j], dt[n], models[j], drift)
            density, ratio, share = _correct(
                mixed_mean[j],
                mixed_cov[j],
                turn,
                swing,
                z[n],
                extra,
                noise,
                noise_prior,
                outlier_rate,
                outlier_variance,
                branch,
            )
            weight[n, j] = predicted[j] * density
            total += weight[n, j]
            misread += weight[n, j] * share
            surprise[n] += weight[n, j] * ratio
            for k in range(levels):
                noise_post[k] += predicted[j] * (branch[k] + branch[levels] * noise_prior[k])
        kept = 0.0
        for k in range(levels):
            kept += noise_post[k]
        for k in range(levels):
            noise_weight[n, k] = noise_post[k] / kept if kept > 1e-290 else noise_prior[k]
        for j in range(count):
            weight[n, j] = weight[n, j] / total if total > 1e-290 else predicted[j]
        encoder_error[n] = misread / total if total > 1e-290 else 0.0 + 0.0j
        surprise[n] = surprise[n] / total if total > 1e-290 else 0.0
        log_likelihood[n] = math.log(max(total, 1e-300))
        for j in range(count):
            for r in range(STATE_SIZE):
                mean[n, j, r] = mixed_mean[j, r]
                for c in range(STATE_SIZE):
                    cov[n, j, r, c] = mixed_cov[j, r, c]
