"""Control law of a planar two-link arm whose vectors in the image are known: inverse kinematics in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.laws import NoLawState
from servotrack.estimators.jacobian.lifted import LiftedEstimate
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class ElbowLaw:
    """Law that moves the joints straight to the angles that hold the tool over the target one period later.

    With the target a, the elbow b and the forearm d as vectors in the image (see `LiftedEstimate`), a motion of the
    joints (m1, m2) solves exp(i (m1 + m2)) a - exp(i m2) b - d = 0: the law of cosines gives m2, the direction m1. The
    elbow stays on its side. Unlike laws that go straight in the image it neither stops at a singular pose nor takes a
    way around through the joint stops. It needs an estimate of b and d that is right from the start.

    Args:
        period: Control period, s.
    """

    period: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 < self.period < np.inf:
            raise ValueError(f"period must be finite and > 0 s, got {self.period}")

    def initial(self, measurement: ServoMeasurement) -> NoLawState:
        """Return the empty state."""
        return NoLawState()

    def rate(self, state: NoLawState, estimate: ServoEstimate) -> tuple[NoLawState, Array]:
        """Return the unchanged state and the joint rates. Shape (*batch, 2), rad/s.

        Raises:
            ValueError: An estimate without the arm's vectors.
        """
        if not isinstance(estimate, LiftedEstimate):
            raise ValueError(f"ElbowLaw needs a LiftedEstimate, got {type(estimate).__name__}; use OneStepExact")
        dt = self.period
        target = estimate.target + dt * estimate.velocity + 0.5 * dt * dt * estimate.acceleration
        elbow, forearm = estimate.elbow, estimate.forearm
        upper, lower = np.maximum(np.abs(elbow), 1e-12), np.maximum(np.abs(forearm), 1e-12)
        bend = np.angle(forearm * np.conj(elbow))
        cosine = np.clip((np.abs(target) ** 2 - upper**2 - lower**2) / (2.0 * upper * lower), -1.0, 1.0)
        side = np.where(bend < 0.0, -1.0, 1.0)
        second = bend - side * np.arccos(cosine)
        reached = np.exp(1j * second) * elbow + forearm
        first = np.angle(reached * np.conj(target)) - second
        return state, np.stack([(first + np.pi) % (2.0 * np.pi) - np.pi, second], axis=-1) / dt
