"""Compiled recursion of the lifted Kalman filter: interacting multiple models over a five-dimensional complex state.

Plane vectors are complex numbers u + iv: every quantity of the filter rotates and scales without shear. The mean is a
complex vector and the covariance is Hermitian, which halves the work of the real form.

A batch row holds M target models (see `TargetModel`). Within each model, the noise of a feature is a mixture over L
standard deviations, whose weights are estimated, and an outlier of fixed probability. All branches of one model share
the direction of the gain, so that their exact mean and covariance follow at no extra cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.definite import is_definite, repair
from servotrack.estimators.types import Array, ComplexArray

STATE_SIZE = 5
"""Target A, its velocity V and acceleration G, elbow B, tool minus elbow D; px, px/s, px/s^2, px, px."""
LEAST_VARIANCE_SHARE = 1e-11
"""Smallest share of a variance that a measurement may leave: below it the difference is rounding."""
ROUNDED_SHARE = 1e-6
"""Share of a variance below which rounding affects the remaining correlations."""
ROUNDING = 4e-12
"""Rounding error of a difference, relative to the minuend."""


class LiftedParameters(NamedTuple):
    """Parameters of `lifted_update`. The variance of a complex number sums both axes.

    Attributes:
        models: Spectral densities of white jerk, px^2/s^5, and white acceleration, px^2/s^3; recall, 1/s^2; damping,
            1/s. Shape (M, 4).
        drift: Spectral density of the random walk of A, B and D, px^2/s.
        model_stay: Probability to keep the model from frame to frame.
        noise: Variances of the noise levels. Shape (L,), px^2.
        noise_stay: Probability to keep the noise level from frame to frame.
        encoder_variance: Variance of a joint angle, rad^2.
        optics_variance: Squared relative error of the optics.
        outlier_rate: Probability of an outlier.
        outlier_variance: Variance that an outlier adds, px^2.
    """

    models: Array
    drift: float
    model_stay: float
    noise: Array
    noise_stay: float
    encoder_variance: float
    optics_variance: float
    outlier_rate: float
    outlier_variance: float


class LiftedScores(NamedTuple):
    """Output arrays of `lifted_update`.

    Attributes:
        log_likelihood: Log density of the measurement, 0 without a new frame. Shape (rows,).
        nis: Squared innovation over its covariance, expected over all branches. Shape (rows,).
        encoder_error: Expected contribution of the encoder noise at the frame to the image, u + iv. Shape (rows,), px.
    """

    log_likelihood: Array
    nis: Array
    encoder_error: ComplexArray


@njit(cache=True, nogil=True)
def _mix(mean, cov, weight, stay, mixed_mean, mixed_cov, predicted):  # type: ignore[no-untyped-def]
    """Interaction step (Blom and Bar-Shalom 1988): moments of each model after possible switches between models.

    All switches are equally likely, so model j is a mixture of itself and of all models. One pass over the models
    computes the joint moments, about their common mean to avoid cancellation; a second pass computes each model's.
    """
    models = weight.shape[0]
    leave = (1.0 - stay) / (models - 1) if models > 1 else 0.0
    own = stay - leave if models > 1 else 1.0
    center = np.zeros(STATE_SIZE, dtype=np.complex128)
    pooled = np.zeros((STATE_SIZE, STATE_SIZE), dtype=np.complex128)
    for i in range(models):
        for r in range(STATE_SIZE):
            center[r] += weight[i] * mean[i, r]
    for i in range(models):
        for r in range(STATE_SIZE):
            for c in range(r + 1):
                spread = (mean[i, r] - center[r]) * np.conj(mean[i, c] - center[c])
                mixed_cov[i, r, c] = cov[i, r, c] + spread
                pooled[r, c] += weight[i] * mixed_cov[i, r, c]
    for j in range(models):
        predicted[j] = own * weight[j] + leave
        from_own, from_all = own * weight[j] / predicted[j], leave / predicted[j]
        for r in range(STATE_SIZE):
            mixed_mean[j, r] = center[r] + from_own * (mean[j, r] - center[r])
        for r in range(STATE_SIZE):
            for c in range(r + 1):
                shift = (mixed_mean[j, r] - center[r]) * np.conj(mixed_mean[j, c] - center[c])
                mixed_cov[j, r, c] = from_own * mixed_cov[j, r, c] + from_all * pooled[r, c] - shift
                mixed_cov[j, c, r] = np.conj(mixed_cov[j, r, c])


@njit(cache=True, nogil=True)
def _predict(mean, cov, dt, model, drift):  # type: ignore[no-untyped-def]
    """Predict one model's target over `dt`: V' = G + white acceleration, G' = -recall V - damping G + white jerk."""
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
def _correct(mean, cov, turn, swing, z, noise_weight, parameters, branch, factor):  # type: ignore[no-untyped-def]
    """Update one model with z = turn A - swing B - D + noise, with exact moments over all noise branches.

    `branch` (L + 1,) receives the joint density of the measurement and each branch; `factor` (5, 5) is scratch. Returns
    the density of the measurement, the NIS expected over the branches, and the part of the innovation due to encoder
    noise.
    """
    noise, outlier_rate, outlier_variance = parameters.noise, parameters.outlier_rate, parameters.outlier_variance
    g = np.empty(STATE_SIZE, dtype=np.complex128)
    turn_c, swing_c = np.conj(turn), np.conj(swing)
    for s in range(STATE_SIZE):
        g[s] = cov[s, 0] * turn_c - cov[s, 3] * swing_c - cov[s, 4]
    innovation = z - (turn * mean[0] - swing * mean[3] - mean[4])
    spread = max((turn * g[0] - swing * g[3] - g[4]).real, 0.0)
    nu2 = innovation.real * innovation.real + innovation.imag * innovation.imag
    # Encoder noise rotates the arm vectors and residual optics scales the error: both variances grow with the vectors.
    a, b = turn * mean[0], swing * mean[3]
    error = a - b - mean[4]
    arms = a.real * a.real + a.imag * a.imag + (a - b).real ** 2 + (a - b).imag ** 2
    by_joints = parameters.encoder_variance * arms
    base = by_joints + parameters.optics_variance * (error.real * error.real + error.imag * error.imag)
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
        cov[r, r] = complex(max(cov[r, r].real, LEAST_VARIANCE_SHARE * before[r], 1e-12), 0.0)
        share = cov[r, r].real / before[r] if before[r] > 0.0 else 1.0
        if share < ROUNDED_SHARE:
            # Rounding errors of the difference contaminate the remaining correlations, which are therefore reduced.
            trust[r] = math.sqrt(max(1.0 - ROUNDING / share, 0.0))
    if trust.min() < 1.0:
        for r in range(STATE_SIZE):
            for c in range(r):
                cov[r, c] *= trust[r] * trust[c]
                cov[c, r] = np.conj(cov[r, c])
    if not is_definite(cov, 0.0, factor):
        repair(cov, before, factor)
    return density, nu2 * first, by_joints * first * innovation


@njit(cache=True, nogil=True)
def lifted_update(mean, cov, weight, noise_weight, fresh, dt, joints, z, parameters, scores):  # type: ignore[no-untyped-def]
    """Predict every fresh row over `dt` and update it with its measurement; arrays are changed in place.

    Args:
        mean: Means of the models. Shape (rows, M, 5), complex.
        cov: Covariances of the models. Shape (rows, M, 5, 5), complex.
        weight: Probabilities of the models. Shape (rows, M).
        noise_weight: Probabilities of the noise levels. Shape (rows, L).
        fresh: Mask of the rows with a new frame. Shape (rows,), bool.
        dt: Time since the state's instant. Shape (rows,), s.
        joints: Joint angles at the frame. Shape (rows, 2), rad.
        z: Features minus goal, u + iv. Shape (rows,), px.
        parameters: `LiftedParameters`.
        scores: `LiftedScores`, written for every row.
    """
    rows, count = weight.shape
    levels = parameters.noise.shape[0]
    log_likelihood, nis, encoder_error = scores
    noise_stay = parameters.noise_stay
    mixed_mean, mixed_cov = np.empty_like(mean[0]), np.empty_like(cov[0])
    predicted, noise_prior, noise_post = np.empty(count), np.empty(levels), np.empty(levels)
    branch, factor = np.empty(levels + 1), np.empty_like(cov[0, 0])
    for n in range(rows):
        log_likelihood[n], nis[n], encoder_error[n] = 0.0, 0.0, 0.0 + 0.0j
        if not fresh[n]:
            continue
        swing = complex(math.cos(joints[n, 1]), math.sin(joints[n, 1]))
        angle = joints[n, 0] + joints[n, 1]
        turn = complex(math.cos(angle), math.sin(angle))
        _mix(mean[n], cov[n], weight[n], parameters.model_stay, mixed_mean, mixed_cov, predicted)
        for k in range(levels):
            noise_prior[k] = noise_stay * noise_weight[n, k] + (1.0 - noise_stay) / levels
            noise_post[k] = 0.0
        total, misread = 0.0, 0.0 + 0.0j
        for j in range(count):
            _predict(mixed_mean[j], mixed_cov[j], dt[n], parameters.models[j], parameters.drift)
            density, ratio, share = _correct(
                mixed_mean[j], mixed_cov[j], turn, swing, z[n], noise_prior, parameters, branch, factor
            )
            weight[n, j] = predicted[j] * density
            total += weight[n, j]
            misread += weight[n, j] * share
            nis[n] += weight[n, j] * ratio
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
        nis[n] = nis[n] / total if total > 1e-290 else 0.0
        log_likelihood[n] = math.log(max(total, 1e-300))
        for j in range(count):
            for r in range(STATE_SIZE):
                mean[n, j, r] = mixed_mean[j, r]
                for c in range(STATE_SIZE):
                    cov[n, j, r, c] = mixed_cov[j, r, c]
