"""Control law that moves as far as the estimate is certain (cautious control, Astrom and Wittenmark 1995, sec. 7.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.laws import IntegralState
from servotrack.estimators.symmetric import eigenvectors
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class Cautious:
    """Law that removes a share of the error without more risk than gain.

    The expected squared error after a motion d is |e + J d|^2 + d' C d with C the sum of the covariances of the rows of
    J, all in standard deviations of the error. The law minimizes |g e + J d|^2 with d' C d bounded by a share of the
    error that is to be removed. Directions of d in which J is not known far better than it is large move only as far
    as the error along them is significant. Features whose row is not known at all do not count. No damping constant
    is needed, and an arm with more joints than the image can tell apart does not drift.

    Args:
        gain: Share g of the error to remove in one period, in (0, 1]. Larger values converge faster, amplify noise, and
            oscillate with motors that lag.
        integral_gain: Gain of the time integral of the error, 1/s, which counts while the target moves: it removes what
            the estimate of the target's velocity lags behind. Larger values remove it faster and may oscillate. The
            goal's velocity is known and needs none.
        period: Control period, s.
        risk: Largest expected error from the uncertainty of J, as a share of the error that is to be removed. Larger
            values move faster along a poor estimate.
        certain: Ratio of J to its standard deviation, squared, above which a direction counts as known.
        significance: Error in standard deviations at which a direction that is not known moves by half.
    """

    gain: float = 0.2
    integral_gain: float = 0.5
    period: float = 0.05
    risk: float = 0.5
    certain: float = 25.0
    significance: float = 3.0

    def __post_init__(self) -> None:
        if not 0.0 < self.gain <= 1.0:
            raise ValueError(f"gain must be in (0, 1] (fraction of the error removed in one period), got {self.gain}")
        if not 0.0 <= self.integral_gain < np.inf:
            raise ValueError(f"integral_gain must be finite and >= 0 1/s, got {self.integral_gain}")
        for name in ("period", "risk", "significance"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        if not 0.0 <= self.certain < np.inf:
            raise ValueError(f"certain must be finite and >= 0, got {self.certain}")

    def initial(self, measurement: ServoMeasurement) -> IntegralState:
        """Return a zero integral."""
        return IntegralState(np.zeros(np.shape(measurement.goal)))

    def rate(
        self, state: IntegralState, estimate: ServoEstimate, low: Array | None = None, high: Array | None = None
    ) -> tuple[IntegralState, Array]:
        """Return the new integral of the error and the joint rates. Shape (*batch, n), rad/s.

        Args:
            state: State after the last step.
            estimate: Estimate at present, with covariances.
            low: Motion to the lower limits; not read, since the law looks no farther than a period.
            high: Motion to the upper limits; not read.

        Raises:
            ValueError: An estimate without covariances.
        """
        motion, _, integral = self._solve(estimate, state.integral)
        return IntegralState(integral), motion / self.period

    def within(self, rate: Array, estimate: ServoEstimate, low: Array, high: Array, rows: Mask) -> Array:
        """Joint rates within bounds whose expected squared error is smallest.

        Args:
            rate: Wanted joint rates. Shape (*batch, n), rad/s.
            estimate: Estimate at present.
            low: Least joint rates. Shape (*batch, n), rad/s.
            high: Largest joint rates. Shape (*batch, n), rad/s.
            rows: Rows that are computed; the others stay. Shape (*batch,), bool.

        Returns:
            Joint rates. Shape (*batch, n), rad/s.
        """
        # Only arms at their limits need it, and it takes a while to import.
        from scipy.optimize import lsq_linear

        _, curvature, _ = self._solve(estimate, np.zeros_like(estimate.error))
        rate = np.array(rate)
        for row in map(tuple, np.argwhere(rows)):
            sizes = np.diagonal(curvature[row])
            if not sizes.max() > 0.0:
                continue
            # A little of the identity keeps directions without any effect from running away.
            factor = np.linalg.cholesky(curvature[row] + 1e-9 * sizes.max() * np.eye(len(sizes))).T
            least, most = low[row], np.maximum(high[row], low[row] + 1e-9)
            found = lsq_linear(factor, factor @ rate[row], (least, most), method="bvls")
            rate[row] = found.x
        return rate

    def _solve(self, estimate: ServoEstimate, integral: Array) -> tuple[Array, Array, Array]:
        """Motion of one period, the matrix of the quadratic form that it minimizes, and the new integral.

        Shapes (*batch, n), (*batch, n, n) and (*batch, m).
        """
        covariance, variance = uncertainty(estimate)
        *batch, m, d = estimate.jacobian.shape
        rows = math.prod(batch)
        given = getattr(estimate, "goal_velocity", None)
        motion, curvature, integral = _motions(
            integral.reshape(rows, m),
            np.ascontiguousarray(estimate.error).reshape(rows, m),
            np.zeros((rows, m)) if given is None else np.ascontiguousarray(given).reshape(rows, m),
            np.ascontiguousarray(variance).reshape(rows, m),
            np.ascontiguousarray(estimate.jacobian).reshape(rows, m, d),
            np.ascontiguousarray(covariance).reshape(rows, m, d, d),
            self.period,
            (self.gain, self.integral_gain, self.risk, self.certain, self.significance**2),
        )
        return (
            motion.reshape(*batch, d - 1),
            curvature.reshape(*batch, d - 1, d - 1),
            integral.reshape(*batch, m),
        )


def uncertainty(estimate: Any) -> tuple[Array, Array]:
    """Covariance of the rows of J (*batch, m, n + 1, n + 1) and variance of the error (*batch, m) of an estimate.

    Raises:
        ValueError: The estimate has none.
    """
    covariance, variance = getattr(estimate, "covariance", None), getattr(estimate, "error_variance", None)
    if covariance is None or variance is None:
        raise ValueError(
            "estimate must have covariance and error_variance for the cautious law, got one without; use an estimator "
            "such as AdaptiveKalmanJacobian or KalmanJacobian, or another law such as Proportional"
        )
    return covariance, variance


@njit(cache=True, nogil=True)
def row_weights(jacobian, covariance, variance):  # type: ignore[no-untyped-def]
    """Weight of each feature: 0 where it was not seen, or where its row of J is not known.

    Args:
        jacobian: Total image Jacobian. Shape (m, n + 1).
        covariance: Covariance of each row. Shape (m, n + 1, n + 1).
        variance: Variance of the error. Shape (m,).
    """
    m, d = jacobian.shape
    weights = np.zeros(m)
    for i in range(m):
        if not variance[i] < np.inf:
            continue
        size, doubt = 0.0, 0.0
        for j in range(d - 1):
            size += jacobian[i, j] ** 2
            doubt += covariance[i, j, j]
        weights[i] = max(0.0, 1.0 - doubt / (size + doubt) * 2.0) ** 2 if size > 0.0 else 0.0
    return weights


@njit(cache=True, nogil=True)
def _motions(integrals, errors, given, variances, jacobians, covariances, period, tuning):  # type: ignore[no-untyped-def]
    """Motion of each row within a period, see `Cautious`, and its quadratic form. Shapes (rows, n), (rows, n, n)."""
    gain, integral_gain, risk, certain, significance = tuning
    integrals = integrals.copy()
    rows, m, d = jacobians.shape
    n = d - 1
    motions, curvatures = np.zeros((rows, n)), np.zeros((rows, n, n))
    for row in range(rows):
        jacobian, covariance, variance = jacobians[row], covariances[row], variances[row]
        weights = row_weights(jacobian, covariance, variance)
        gram, doubt = np.zeros((n, n)), np.zeros((n, n))
        pull, along = np.zeros(n), np.zeros(n)
        length, counted, drift, drift_doubt = 0.0, 0.0, 0.0, 0.0
        for i in range(m):
            if weights[i] > 0.0:
                own = jacobian[i, n] + given[row, i]
                drift += weights[i] * own**2 / variance[i]
                drift_doubt += weights[i] * covariance[i, n, n] / variance[i]
        # Steep in the ratio, whose mean over many features hardly passes 2 by chance.
        ratio = min(drift / (4.0 * drift_doubt), 1e3) ** 4 if drift_doubt > 0.0 else 0.0
        lagging = ratio / (1.0 + ratio)
        # A velocity without any variance counts in full, and is not taken to lag.
        known = lagging if drift_doubt > 0.0 else 1.0
        for i in range(m):
            if weights[i] == 0.0:
                continue
            weight = weights[i] / variance[i]
            # The integral stands for what the estimate of the target's velocity lags behind.
            integrals[row, i] = lagging * (integrals[row, i] + period * errors[row, i])
            # The goal's velocity is given, and that of the target counts as far as it is significant.
            velocity = known * (jacobian[i, n] + given[row, i]) - given[row, i]
            wanted = -gain * errors[row, i] - velocity * period - integral_gain * integrals[row, i]
            length += weight * wanted * wanted
            counted += weights[i]
            for j in range(n):
                pull[j] += weight * jacobian[i, j] * wanted
                along[j] += weight * jacobian[i, j] * errors[row, i]
                for k in range(n):
                    gram[j, k] += weight * jacobian[i, j] * jacobian[i, k]
                    doubt[j, k] += weight * covariance[i, j, k]
        if counted == 0.0:
            continue
        rules = (risk**2 * length, 9.0 * counted, certain, significance)
        motions[row], brake = _motion(gram, doubt, pull, along, rules)
        curvatures[row] = gram + brake * doubt
    return motions, curvatures, integrals


@njit(cache=True, nogil=True)
def _motion(gram, doubt, pull, along, tuning):  # type: ignore[no-untyped-def]
    """Minimize d' gram d - 2 pull . d over d' doubt d <= limit, in the directions that diagonalize both matrices."""
    wanted, noise, certain, significance = tuning
    n = len(pull)
    # With doubt = U' S U, the directions are columns of U' S^-1/2 V.
    spreads = np.empty(n)
    first = eigenvectors(doubt, spreads)
    largest = 0.0
    for k in range(n):
        largest = max(largest, spreads[k])
    if not largest > 0.0:
        return np.zeros(n), 0.0
    half = np.empty((n, n))
    for k in range(n):
        root = 1.0 / np.sqrt(max(spreads[k], 1e-12 * largest))
        for j in range(n):
            half[k, j] = root * first[k, j]
    inner = np.zeros((n, n))
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for j in range(n):
                for k in range(n):
                    value += half[a, j] * gram[j, k] * half[b, k]
            inner[a, b] = value
            inner[b, a] = value
    ratios = np.empty(n)
    second = eigenvectors(inner, ratios)
    axes = np.zeros((n, n))
    for a in range(n):
        for b in range(n):
            for j in range(n):
                axes[a, j] += second[a, b] * half[b, j]
    parts = np.zeros(n)
    for k in range(n):
        goal, error = 0.0, 0.0
        for j in range(n):
            goal += axes[k, j] * pull[j]
            error += axes[k, j] * along[j]
        ratios[k] = max(ratios[k], 0.0)
        if ratios[k] < certain:
            squared = error * error / max(ratios[k], 1e-300)
            goal *= squared / (squared + significance)
        parts[k] = goal
    limit = max(wanted, noise)
    brake = _brake(parts, ratios, limit)
    motion = np.zeros(n)
    for k in range(n):
        if ratios[k] + brake > 0.0:
            for j in range(n):
                motion[j] += parts[k] / (ratios[k] + brake) * axes[k, j]
    return motion, brake


@njit(cache=True, nogil=True)
def _brake(parts, ratios, limit):  # type: ignore[no-untyped-def]
    """Smallest b >= 0 with sum (parts / (ratios + b))^2 <= limit, by bisection of its logarithm."""
    least, most = 0.0, 0.0
    for k in range(len(parts)):
        most += parts[k] ** 2
    most = np.sqrt(most / limit)
    if most == 0.0 or _risk(parts, ratios, 0.0) <= limit:
        return 0.0
    least = 1e-12 * most
    if _risk(parts, ratios, least) <= limit:
        return least
    for _ in range(50):
        middle = np.sqrt(least * most)
        if _risk(parts, ratios, middle) <= limit:
            most = middle
        else:
            least = middle
    return most


@njit(cache=True, nogil=True)
def _risk(parts, ratios, brake):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(len(parts)):
        if parts[k] != 0.0:
            size = ratios[k] + brake
            if size == 0.0:
                return np.inf
            total += (parts[k] / size) ** 2
    return total
