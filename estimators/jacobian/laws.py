"""Control laws: joint rates from the estimate of a Jacobian estimator.

A law is a frozen dataclass with `initial(measurement) -> law_state` and `rate(law_state, estimate) -> (law_state,
joint_rate)`. All of them return finite rates at a singular Jacobian: motion along singular directions is damped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from servotrack.estimators.definite import keep_definite
from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.types import Array, Mask


class ControlLaw(Protocol):
    """Interface of the control laws."""

    @property
    def period(self) -> float:
        """Control period, s."""

    def initial(self, measurement: ServoMeasurement) -> Any:
        """Return the state before the first command: arrays with the measurement's batch axes."""

    def rate(self, state: Any, estimate: ServoEstimate) -> tuple[Any, Array]:
        """Return the new state, and the joint rates to hold for one period. Shape (*batch, n), rad/s."""


@runtime_checkable
class BoundedLaw(Protocol):
    """Interface of laws that heed joint limits, and the velocity of a goal that moves (in the estimate's J_t)."""

    @property
    def period(self) -> float:
        """Control period, s."""

    def initial(self, measurement: ServoMeasurement) -> Any:
        """Return the state before the first command: arrays with the measurement's batch axes."""

    def rate(
        self, state: Any, estimate: ServoEstimate, low: Array | None = None, high: Array | None = None
    ) -> tuple[Any, Array]:
        """Return the new state and the wanted joint rates. Shape (*batch, n), rad/s.

        Args:
            state: State after the last step.
            estimate: Estimate at present.
            low: Motion of each joint to its lower limit, at most 0; None: unbounded. Shape (*batch, n), rad.
            high: Motion of each joint to its upper limit, at least 0. Shape (*batch, n), rad.
        """

    def within(self, rate: Array, estimate: ServoEstimate, low: Array, high: Array, rows: Mask) -> Array:
        """Return joint rates within bounds, as near to the wanted ones as the law sees it. Shape (*batch, n), rad/s.

        Args:
            rate: Wanted joint rates. Shape (*batch, n), rad/s.
            estimate: Estimate at present.
            low: Least joint rates. Shape (*batch, n), rad/s.
            high: Largest joint rates. Shape (*batch, n), rad/s.
            rows: Rows whose rates are beyond the bounds; the others stay. Shape (*batch,), bool.
        """


class NoLawState(NamedTuple):
    """Empty state of a law without memory."""


class IntegralState(NamedTuple):
    """State of `ProportionalIntegral`.

    Attributes:
        integral: Time integral of the error. Shape (*batch, m), px s.
    """

    integral: Array


def finite_or_zero(matrices: Array) -> Array:
    """Replace every matrix that has a non-finite entry by zeros. Shape (*batch, m, n)."""
    finite = np.all(np.isfinite(matrices), axis=(-2, -1), keepdims=True)
    return np.where(finite, matrices, 0.0)


def damped_inverse(jacobian: Array, threshold: float) -> Array:
    """Pseudo-inverse that stays bounded at a singularity.

    Singular values of at least `threshold` times the largest are inverted exactly; below, they are damped after
    Nakamura and Hanafusa (1986) so that the inverse falls to zero with the singular value. A zero or non-finite
    matrix gives zero.

    Args:
        jacobian: Matrices to invert. Shape (*batch, m, n).
        threshold: Singular value, relative to the largest, below which damping begins, in [0, 1). Larger values damp
            more.

    Returns:
        Damped inverses. Shape (*batch, n, m).
    """
    left, values, right = np.linalg.svd(finite_or_zero(jacobian), full_matrices=False)
    limit = threshold * values[..., :1]
    damping = np.maximum(limit**2 - values**2, 0.0)
    denominator = values**2 + damping
    inverted = np.divide(values, denominator, out=np.zeros_like(values), where=denominator > 0.0)
    return np.einsum("...ki,...k,...jk->...ij", right, inverted, left)


def _checked_tuning(gain: float, period: float, damping: float) -> None:
    if not 0.0 < gain <= 1.0:
        raise ValueError(f"gain must be in (0, 1] (fraction of the error removed in one period), got {gain}")
    if not 0.0 < period < np.inf:
        raise ValueError(f"period must be finite and > 0 s, got {period}")
    if not 0.0 <= damping < np.inf:
        raise ValueError(f"damping must be finite and >= 0, got {damping}")


@dataclass(frozen=True)
class Proportional:
    """Proportional law with feedforward of the target's motion: dtheta = J_theta^+ (-lambda e - J_t dt) (Zhang 2011).

    Args:
        gain: Fraction lambda of the error to remove in one period, in (0, 1]. Larger values converge faster and
            amplify noise.
        period: Control period dt, s.
        damping: Singular value, relative to the largest, below which the inverse is damped. Larger values are calmer
            near singularities and slower.
    """

    gain: float = 0.7
    period: float = 0.05
    damping: float = 0.03

    def __post_init__(self) -> None:
        _checked_tuning(self.gain, self.period, self.damping)

    def initial(self, measurement: ServoMeasurement) -> NoLawState:
        """Return the empty state."""
        return NoLawState()

    def rate(self, state: NoLawState, estimate: ServoEstimate) -> tuple[NoLawState, Array]:
        """Return the unchanged state and the joint rates. Shape (*batch, n), rad/s."""
        jacobian = estimate.jacobian
        wanted = -self.gain * estimate.error - jacobian[..., -1] * self.period
        motion = np.einsum("...ij,...j->...i", damped_inverse(jacobian[..., :-1], self.damping), wanted)
        return state, motion / self.period


@dataclass(frozen=True)
class ProportionalIntegral:
    """Proportional-integral law: dtheta = J_theta^+ (-lambda e - k_i int e dt - J_t dt).

    Every filter of J_t lags behind an accelerating target, which leaves a slowly changing error. The integral removes
    it.

    Args:
        gain: Fraction lambda of the error to remove in one period, in (0, 1]. Larger values converge faster and
            amplify noise.
        integral_gain: Integral gain k_i, 1/s. Larger values remove a lasting error faster and may oscillate.
        integral_limit: Bound of each component of the integral, px s. It prevents windup while the rate is limited.
        period: Control period dt, s.
        damping: Singular value, relative to the largest, below which the inverse is damped. Larger values are calmer
            near singularities and slower.
    """

    gain: float = 0.5
    integral_gain: float = 1.5
    integral_limit: float = 3.0
    period: float = 0.05
    damping: float = 0.03

    def __post_init__(self) -> None:
        _checked_tuning(self.gain, self.period, self.damping)
        for name, value in (("integral_gain", self.integral_gain), ("integral_limit", self.integral_limit)):
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {value}")

    def initial(self, measurement: ServoMeasurement) -> IntegralState:
        """Return a zero integral."""
        return IntegralState(np.zeros(np.shape(measurement.goal)))

    def rate(self, state: IntegralState, estimate: ServoEstimate) -> tuple[IntegralState, Array]:
        """Return the unchanged state and the joint rates. Shape (*batch, n), rad/s."""
        jacobian = estimate.jacobian
        error = np.where(np.isfinite(estimate.error), estimate.error, 0.0)
        integral = np.clip(state.integral + error * self.period, -self.integral_limit, self.integral_limit)
        wanted = -self.gain * estimate.error - self.integral_gain * integral - jacobian[..., -1] * self.period
        motion = np.einsum("...ij,...j->...i", damped_inverse(jacobian[..., :-1], self.damping), wanted)
        return IntegralState(integral), motion / self.period


@dataclass(frozen=True)
class DampedLeastSquares:
    """Damped least-squares law: dtheta = J' (J J' + mu^2 I)^-1 (-lambda e - J_t dt) with J = J_theta.

    Compared with `Proportional`, it converges more slowly and moves less near singularities.

    Args:
        gain: Fraction lambda of the error to remove in one period, in (0, 1]. Larger values converge faster and
            amplify noise.
        period: Control period dt, s.
        damping: Damping mu at every Jacobian, px/rad. Larger values move less.
    """

    gain: float = 0.7
    period: float = 0.05
    damping: float = 20.0

    def __post_init__(self) -> None:
        _checked_tuning(self.gain, self.period, self.damping)
        if self.damping == 0.0:
            raise ValueError("damping must be > 0 px/rad, got 0.0; use Proportional for an undamped law")

    def initial(self, measurement: ServoMeasurement) -> NoLawState:
        """Return the empty state."""
        return NoLawState()

    def rate(self, state: NoLawState, estimate: ServoEstimate) -> tuple[NoLawState, Array]:
        """Return the unchanged state and the joint rates. Shape (*batch, n), rad/s."""
        jacobian = finite_or_zero(estimate.jacobian)
        wanted = -self.gain * estimate.error - jacobian[..., -1] * self.period
        by_joints = jacobian[..., :-1]
        gram = np.einsum("...ik,...jk->...ij", by_joints, by_joints) + self.damping**2 * np.eye(by_joints.shape[-2])
        # Beside Jacobians that no camera has, the damping is lost in rounding.
        gram = keep_definite(gram, np.einsum("...ii->...i", gram))
        motion = np.einsum("...ij,...i->...j", by_joints, np.linalg.solve(gram, wanted[..., None])[..., 0])
        return state, motion / self.period


@dataclass(frozen=True)
class OneStepExact:
    """Law that solves predict_error(dtheta, dt) = (1 - lambda) e for dtheta, by chord steps with the present Jacobian.

    With a linear prediction (`LinearEstimate`) it equals `Proportional`. With an exact prediction (`LiftedEstimate`) it
    removes exactly the fraction lambda, also in large motions.

    Args:
        gain: Fraction lambda of the error to remove in one period, in (0, 1]. Larger values converge faster and
            amplify noise.
        period: Control period dt, s.
        damping: Singular value, relative to the largest, below which the inverse is damped. Larger values are calmer
            near singularities and slower.
        iterations: Number of chord steps. Larger values are more accurate and slower.
        max_step: Largest motion of one joint in one period, rad. A farther goal is approached along a straight line
            in the image, so that the linearization is used only where it holds.
    """

    gain: float = 0.7
    period: float = 0.05
    damping: float = 0.03
    iterations: int = 4
    max_step: float = 0.1

    def __post_init__(self) -> None:
        _checked_tuning(self.gain, self.period, self.damping)
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        if not 0.0 < self.max_step < np.inf:
            raise ValueError(f"max_step must be finite and > 0 rad, got {self.max_step}")

    def initial(self, measurement: ServoMeasurement) -> NoLawState:
        """Return the empty state."""
        return NoLawState()

    def rate(self, state: NoLawState, estimate: ServoEstimate) -> tuple[NoLawState, Array]:
        """Return the unchanged state and the joint rates. Shape (*batch, n), rad/s."""
        inverse = damped_inverse(estimate.jacobian[..., :-1], self.damping)
        drifted = estimate.predict_error(np.zeros(inverse.shape[:-1]), self.period)
        motion = np.einsum("...ij,...j->...i", inverse, (1.0 - self.gain) * estimate.error - drifted)
        share = limiting_factor(motion, self.max_step)
        target = drifted + share * ((1.0 - self.gain) * estimate.error - drifted)
        motion = share * motion
        for _ in range(self.iterations - 1):
            left = target - estimate.predict_error(motion, self.period)
            motion = motion + np.einsum("...ij,...j->...i", inverse, left)
            motion = limiting_factor(motion, self.max_step) * motion
        return state, motion / self.period


def limiting_factor(motion: Array, limit: float) -> Array:
    """Factor, at most 1, that scales the largest |component| of each vector down to `limit`. Shape (*batch, 1).

    Scaling the whole vector keeps its direction. Clipping each joint separately would turn the tool towards the
    singularity.

    Args:
        motion: Vectors to limit. Shape (*batch, n).
        limit: Largest allowed |component|, in the unit of `motion`.
    """
    largest = np.abs(motion).max(axis=-1, keepdims=True)
    return np.divide(limit, largest, out=np.ones_like(largest), where=largest > limit)
