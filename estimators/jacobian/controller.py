"""Complete servo loop: estimator, control law, exploratory moves and supervisor. It also drives a real robot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.jacobian.contract import JacobianEstimator, ServoMeasurement
from servotrack.estimators.jacobian.excitation import Excitation
from servotrack.estimators.jacobian.laws import ControlLaw, ProportionalIntegral, limiting_factor
from servotrack.estimators.jacobian.supervisor import Supervisor, SupervisorState
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Labels


class ControllerState(NamedTuple):
    """State of a `ServoController`.

    Attributes:
        estimator: State of the estimator.
        law: State of the law.
        supervisor: State of the supervisor.
        move: Index of the next exploratory move; exploration ends at `Excitation.steps`. Shape (*batch,), int.
        direction: Direction of each joint in outward exploratory moves, +1 or -1. Shape (*batch, n).
        commanded: Motion commanded at the last step. Shape (*batch, n), rad.
    """

    estimator: Any
    law: Any
    supervisor: SupervisorState
    move: Labels
    direction: Array
    commanded: Array


@dataclass(frozen=True)
class ServoController:
    """Servo controller: measurements in, joint rates out.

    The controller makes exploratory moves at the start, then applies the law to the estimate. While the target is out
    of view, it first follows the prediction and then returns to the joint angles at which the target was last seen.
    When the supervisor detects a wrong estimate, the controller resets the estimator's covariance (`forget(state) ->
    state`, if the estimator has it) and explores again.

        controller = ServoController(KalmanJacobian())
        state = controller.initial(measurement)
        while True:
            state, joint_rate = controller.step(state, measurement)

    Args:
        estimator: Estimator of the total image Jacobian.
        law: Control law.
        excitation: Exploratory moves; `steps=0` disables them.
        supervisor: Detector of a wrong estimate; None disables it.
        max_joint_rate: Limit of each joint rate, rad/s. The whole vector is scaled, so that its direction stays.
    """

    estimator: JacobianEstimator
    law: ControlLaw = field(default_factory=ProportionalIntegral)
    excitation: Excitation = field(default_factory=Excitation)
    supervisor: Supervisor | None = field(default_factory=Supervisor)
    max_joint_rate: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 < self.max_joint_rate < np.inf:
            raise ValueError(f"max_joint_rate must be finite and > 0 rad/s, got {self.max_joint_rate}")

    def initial(self, measurement: ServoMeasurement) -> ControllerState:
        """State before the first `step`, to which the same measurement must be passed.

        Raises:
            ValueError: As the estimator does for a bad measurement.
        """
        estimator_state = self.estimator.initial(measurement)
        shape = np.shape(measurement.joint_angles)
        return ControllerState(
            estimator=estimator_state,
            law=self.law.initial(measurement),
            supervisor=(self.supervisor or Supervisor()).initial(measurement),
            move=np.zeros(shape[:-1], dtype=np.int64),
            direction=np.ones(shape),
            commanded=np.zeros(shape),
        )

    def step(self, state: ControllerState, measurement: ServoMeasurement) -> tuple[ControllerState, Array]:
        """Update with one measurement and return the joint rates until the next one.

        Returns:
            The new state, and joint rates within `max_joint_rate`. Shape (*batch, n), rad/s.

        Raises:
            ValueError: As the estimator does for a bad measurement.
        """
        estimator_state, estimate = self.estimator.step(state.estimator, measurement)
        law_state, rate = self.law.rate(state.law, estimate)
        watch, move, direction = state.supervisor, state.move, state.direction

        if self.supervisor is not None:
            watch, verdict = self.supervisor.step(watch, measurement, estimate, state.commanded)
            back = (watch.last_seen_joints - np.asarray(measurement.joint_angles)) / self.law.period
            rate = np.where(verdict.lost[..., None], back, rate)
            excite = verdict.excite & (move >= self.excitation.steps)
            if excite.any():
                if hasattr(self.estimator, "forget"):
                    estimator_state = select_rows(excite, self.estimator.forget(estimator_state), estimator_state)
                law_state = select_rows(excite, self.law.initial(measurement), law_state)
                move = np.where(excite, 0, move)
                # A blocked joint is at its stop, so it explores in the opposite direction.
                away = np.where(watch.blocked > 0, -np.sign(state.commanded), direction)
                direction = np.where(excite[..., None] & (away != 0.0), away, direction)
                watch = select_rows(excite, self.supervisor.initial(measurement), watch)

        probing = move < self.excitation.steps
        rate = np.where(probing[..., None], self.excitation.rate(move, direction), rate)
        rate = np.where(np.isfinite(rate), rate, 0.0)
        rate = limiting_factor(rate, self.max_joint_rate) * rate
        new_state = ControllerState(
            estimator_state, law_state, watch, np.where(probing, move + 1, move), direction, rate * self.law.period
        )
        return new_state, rate
