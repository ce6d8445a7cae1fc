"""Compiled kernels of all Gaussian filters here: predict, condition on a measurement, compute pair likelihoods.

A target is the pair xi = (x, y) of its state and its measurement (Pieczynski and Desbouvries 2003). A component is a
Gaussian over xi. After a detection its y is known exactly: the y block of its covariance is zero and the y part of its
mean is the measurement (a Dirac). Under a hidden Markov model y has no influence on the next step, the y columns of the
transition are zero, and the same code runs over the x columns only. So one recursion serves both models:

    predict     mu = B xi,  P = B P B^T + Sigma, over the x columns only for a Dirac
    condition   K = P_xy P_yy^-1,  m = mu_x + K (z - mu_y),  P_xx - K P_yx

For a non-linear measurement the y rows are computed from the predicted x by an extended or unscented transform.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.definite import LEAST_SHARE, is_definite, repair
from servotrack.estimators.rfs.range_bearing import linearized_range_bearing, unscented_range_bearing
from servotrack.estimators.types import Array, Labels, Mask

LINEAR, EXTENDED, UNSCENTED, FUNCTION = 0, 1, 2, 3
"""Kinds of measurement: linear, range and bearing by an extended or an unscented transform, or a caller's function."""

SMALLEST_LIKELIHOOD = 1e-300
"""Pairs of smaller likelihood are dropped: near underflow their quotients would be meaningless."""


class PackedModel(NamedTuple):
    """Arrays of a model for the compiled kernels; N = n + m.

    Attributes:
        kind: LINEAR, EXTENDED, UNSCENTED or FUNCTION.
        pairwise: True if y influences the next step.
        transition: B. Shape (N, N).
        noise: Sigma. Shape (N, N).
        observation: H of y = H x + noise; for range and bearing the rows that select the position. Shape (m, n).
        measurement_noise: R. Shape (m, m).
        sensor: Position of a range-bearing sensor. Shape (2,), m.
        angular: Mask of the entries of y that are angles, whose innovations wrap. Shape (m,), bool.
    """

    kind: int
    pairwise: bool
    transition: Array
    noise: Array
    observation: Array
    measurement_noise: Array
    sensor: Array
    angular: Mask


class Pairs(NamedTuple):
    """Pairs of a component and a measurement in its gate.

    Attributes:
        component: Index of the component. Shape (P,).
        measurement: Index of the measurement. Shape (P,).
        likelihood: Likelihood, times p_D and the component's weight where these are known. Shape (P,).
        part: Row of each pair in `gain` and in the posterior covariances. Shape (P,).
        gain: Gains. Shape (parts, n, m).
    """

    component: Labels
    measurement: Labels
    likelihood: Array
    part: Labels
    gain: Array


def pack_model(
    kind: int,
    pairwise: bool,
    transition: Array,
    noise: Array,
    observation: Array,
    measurement_noise: Array,
    sensor: tuple[float, float] = (0.0, 0.0),
    angular: tuple[bool, ...] | None = None,
) -> PackedModel:
    """Copy the matrices to contiguous, writable arrays; the kernels are compiled for this memory layout."""

    def copy(matrix: ArrayLike) -> Array:
        return np.array(matrix, dtype=np.float64, order="C")

    return PackedModel(
        kind,
        pairwise,
        copy(transition),
        copy(noise),
        copy(observation),
        copy(measurement_noise),
        copy(sensor),
        np.array(angular or (False,) * observation.shape[0]),
    )


@njit(cache=True, nogil=True)
def cholesky_inverse(matrix, size, offset, inverse):  # type: ignore[no-untyped-def]
    """Invert the Cholesky factor of a diagonal block and return the sum of its log diagonal, NaN if not definite."""
    log_diagonal = 0.0
    for r in range(size):
        for c in range(r + 1):
            value = matrix[offset + r, offset + c]
            for k in range(c):
                value -= inverse[r, k] * inverse[c, k]
            if r == c:
                if not value > 0.0:
                    return np.nan
                inverse[r, r] = math.sqrt(value)
                log_diagonal += math.log(inverse[r, r])
            else:
                inverse[r, c] = value / inverse[c, c]
    for c in range(size):
        inverse[c, c] = 1.0 / inverse[c, c]
        for r in range(c + 1, size):
            value = 0.0
            for k in range(c, r):
                value -= inverse[r, k] * inverse[k, c]
            inverse[r, c] = value / inverse[r, r]
            inverse[c, r] = 0.0
    return log_diagonal


@njit(cache=True, nogil=True)
def attach_measurement(model, mean, cov):  # type: ignore[no-untyped-def]
    """Fill the y blocks of a component from its x block: predicted measurement and covariances."""
    m, n = model.observation.shape
    if model.kind == FUNCTION:
        # The kernels cannot call it; `SensedModel.attach` fills the blocks of all components at once.
        return
    if model.kind == EXTENDED:
        linearized_range_bearing(model.observation, model.measurement_noise, model.sensor, mean, cov)
    elif model.kind == UNSCENTED:
        unscented_range_bearing(model.observation, model.measurement_noise, model.sensor, mean, cov)
    else:
        H = model.observation
        for r in range(m):
            mean[n + r] = 0.0
            for k in range(n):
                mean[n + r] += H[r, k] * mean[k]
            for c in range(n):
                cov[n + r, c] = 0.0
                for k in range(n):
                    cov[n + r, c] += H[r, k] * cov[k, c]
                cov[c, n + r] = cov[n + r, c]
        for r in range(m):
            for c in range(r + 1):
                value = model.measurement_noise[r, c]
                for k in range(n):
                    value += cov[n + r, k] * H[c, k]
                cov[n + r, n + c] = value
                cov[n + c, n + r] = value


@njit(cache=True, nogil=True)
def predict_gaussian(model, mean, cov, detected, work, out_mean, out_cov):  # type: ignore[no-untyped-def]
    """Predict one component: mu = B xi, P = B P B^T + Sigma, over the x columns only if y is exact or dropped."""
    m, n = model.observation.shape
    rows = n + m if model.kind == LINEAR else n
    mean_columns = n + m if model.pairwise else n
    columns = n + m if model.pairwise and not detected else n
    B = model.transition
    for r in range(rows):
        value = 0.0
        for k in range(mean_columns):
            value += B[r, k] * mean[k]
        out_mean[r] = value
        for c in range(columns):
            work[r, c] = 0.0
        for k in range(columns):
            if B[r, k] != 0.0:
                for c in range(columns):
                    work[r, c] += B[r, k] * cov[k, c]
    for r in range(rows):
        for c in range(r + 1):
            value = model.noise[r, c]
            for k in range(columns):
                value += work[r, k] * B[c, k]
            out_cov[r, c] = value
            out_cov[c, r] = value
    if model.kind != LINEAR:
        attach_measurement(model, out_mean, out_cov)


@njit(cache=True, nogil=True)
def condition_gaussian(model, cov, root, gain, posterior):  # type: ignore[no-untyped-def]
    """Gain and posterior covariance of a predicted component, which do not depend on the measurement's value.

    Args:
        model: The packed model.
        cov: Predicted covariance. Shape (N, N).
        root: Output: inverse Cholesky factor of P_yy. Shape (m, m).
        gain: Output: K. Shape (n, m).
        posterior: Output: P_xx - K P_yx. Shape (n, n).

    Returns:
        log of (2 pi)^(-m/2) det(P_yy)^(-1/2); NaN if P_yy is not positive definite.
    """
    m, n = model.observation.shape
    log_diagonal = cholesky_inverse(cov, m, n, root)
    _fill_gain(model, cov, root, gain, posterior)
    return -log_diagonal - 0.5 * m * math.log(2.0 * math.pi)


@njit(cache=True, nogil=True)
def _fill_gain(model, cov, root, gain, posterior):  # type: ignore[no-untyped-def]
    """Gain and posterior covariance from the inverse Cholesky factor of P_yy; arguments as above."""
    m, n = model.observation.shape
    whitened = np.empty((n, m))
    for r in range(n):
        for c in range(m):
            value = 0.0
            for k in range(c + 1):
                value += cov[r, n + k] * root[c, k]
            whitened[r, c] = value
        for c in range(m):
            value = 0.0
            for k in range(c, m):
                value += whitened[r, k] * root[k, c]
            gain[r, c] = value
        for c in range(r + 1):
            value = cov[r, c]
            for k in range(m):
                value -= whitened[r, k] * whitened[c, k]
            posterior[r, c] = value
            posterior[c, r] = value
    if model.kind != LINEAR:
        _keep_posterior(posterior, cov)


@njit(cache=True, nogil=True)
def _keep_posterior(posterior, cov):  # type: ignore[no-untyped-def]
    """Repair a posterior of range and bearing in place: near the sensor a bearing leaves next to no variance."""
    n = posterior.shape[0]
    factor, before = np.empty((n, n)), np.empty(n)
    if not is_definite(posterior, LEAST_SHARE, factor):
        for r in range(n):
            before[r] = cov[r, r]
        repair(posterior, before, factor)


@njit(cache=True, nogil=True)
def innovate(model, z, mean, innovation):  # type: ignore[no-untyped-def]
    """Compute the innovation z - mu_y, angles wrapped to [-pi, pi)."""
    m, n = model.observation.shape
    for r in range(m):
        innovation[r] = z[r] - mean[n + r]
        if model.angular[r]:
            innovation[r] -= 2.0 * math.pi * math.floor(innovation[r] / (2.0 * math.pi) + 0.5)


@njit(cache=True, nogil=True)
def weigh_pairs(model, count, mean, cov, measurements, excess, number, gate):  # type: ignore[no-untyped-def]
    """Likelihoods q_i(z_j) of all pairs of a component and a measurement inside the gate.

    Args:
        model: The packed model.
        count: Number of components in use, J.
        mean: Predicted means. Shape (>= J, N).
        cov: Predicted covariances. Shape (>= J, N, N).
        measurements: Measurements. Shape (>= Z, m).
        excess: R_j - R of each measurement; no rows if all have the model's R. Shape (>= Z or 0, m, m).
        number: Number of measurements in use, Z.
        gate: Largest squared Mahalanobis distance of a pair.

    Returns:
        component (pairs,), measurement (pairs,), likelihood (pairs,): pairs in order of components, then of
        measurements; part (pairs,), the row of each pair in gain (parts, n, m) and posterior (parts, n, n), which is
        its component if all measurements have the same noise; True if every P_yy is positive definite. Rows of
        components without a pair hold arbitrary values.
    """
    if excess.shape[0] > 0:
        return _weigh_each_pair(model, count, mean, cov, measurements, excess, number, gate)
    m, n = model.observation.shape
    component = np.empty(count * number, np.int32)
    measurement = np.empty(count * number, np.int32)
    likelihood = np.empty(count * number)
    gain = np.empty((count, n, m))
    posterior = np.empty((count, n, n))
    root = np.empty((m, m))
    innovation = np.empty(m)
    pairs = 0
    positive_definite = True
    for i in range(count):
        log_diagonal = cholesky_inverse(cov[i], m, n, root)
        if math.isnan(log_diagonal):
            positive_definite = False
            continue
        log_norm, before = -log_diagonal - 0.5 * m * math.log(2.0 * math.pi), pairs
        reach = gate * cov[i, n, n]
        wraps = model.angular[0]
        for j in range(number):
            # d^2 is at least the squared innovation of the first entry over its variance; most pairs end here.
            first = measurements[j, 0] - mean[i, n]
            if first * first > reach and not wraps:
                continue
            innovate(model, measurements[j], mean[i], innovation)
            distance = 0.0
            for r in range(m):
                value = 0.0
                for k in range(r + 1):
                    value += root[r, k] * innovation[k]
                distance += value * value
            if distance <= gate:
                q = math.exp(log_norm - 0.5 * distance)
                if q > SMALLEST_LIKELIHOOD:
                    component[pairs] = i
                    measurement[pairs] = j
                    likelihood[pairs] = q
                    pairs += 1
        if pairs > before:
            # Most components are far from every measurement, and need no gain.
            _fill_gain(model, cov[i], root, gain[i], posterior[i])
    component = component[:pairs]
    return component, measurement[:pairs], likelihood[:pairs], component, gain, posterior, positive_definite


@njit(cache=True, nogil=True)
def _weigh_each_pair(model, count, mean, cov, measurements, excess, number, gate):  # type: ignore[no-untyped-def]
    """`weigh_pairs` with a noise of its own for each measurement: every pair has its own gain and posterior."""
    m, n = model.observation.shape
    component = np.empty(count * number, np.int32)
    measurement = np.empty(count * number, np.int32)
    likelihood = np.empty(count * number)
    root, innovation, noisy = np.empty((m, m)), np.empty(m), np.empty((n + m, n + m))
    pairs = 0
    positive_definite = True
    for i in range(count):
        for j in range(number):
            first = measurements[j, 0] - mean[i, n]
            if first * first > gate * (cov[i, n, n] + excess[j, 0, 0]) and not model.angular[0]:
                continue
            add_noise(model, cov[i], excess[j], noisy)
            log_diagonal = cholesky_inverse(noisy, m, n, root)
            if math.isnan(log_diagonal):
                positive_definite = False
                continue
            innovate(model, measurements[j], mean[i], innovation)
            distance = 0.0
            for r in range(m):
                value = 0.0
                for k in range(r + 1):
                    value += root[r, k] * innovation[k]
                distance += value * value
            q = math.exp(-log_diagonal - 0.5 * m * math.log(2.0 * math.pi) - 0.5 * distance)
            if distance <= gate and q > SMALLEST_LIKELIHOOD:
                component[pairs], measurement[pairs], likelihood[pairs] = i, j, q
                pairs += 1
    gain, posterior = np.empty((pairs, n, m)), np.empty((pairs, n, n))
    for p in range(pairs):
        add_noise(model, cov[component[p]], excess[measurement[p]], noisy)
        condition_gaussian(model, noisy, root, gain[p], posterior[p])
    part = np.arange(pairs).astype(np.int32)
    return component[:pairs], measurement[:pairs], likelihood[:pairs], part, gain, posterior, positive_definite


@njit(cache=True, nogil=True)
def add_noise(model, cov, excess, out):  # type: ignore[no-untyped-def]
    """Predicted covariance of a component for a measurement whose noise exceeds the model's."""
    m, n = model.observation.shape
    out[:] = cov
    for r in range(m):
        for c in range(m):
            out[n + r, n + c] += excess[r, c]


@njit(cache=True, nogil=True)
def detected_mean(model, mean, gain, z, innovation, out_mean):  # type: ignore[no-untyped-def]
    """Mean after a detection: x corrected by the gain, y equal to the measurement."""
    m, n = model.observation.shape
    innovate(model, z, mean, innovation)
    for r in range(n):
        value = mean[r]
        for k in range(m):
            value += gain[r, k] * innovation[k]
        out_mean[r] = value
    for r in range(m):
        out_mean[n + r] = z[r]
