"""Anchor estimators of the Jacobian: one is fixed after the first moves, one returns the true Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.kf import KalmanJacobian, KalmanState
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Labels


class FixedState(NamedTuple):
    """State of `FixedJacobian`.

    Attributes:
        learner: State of the filter during the exploratory moves; later only its alignment changes.
        steps: Number of steps so far. Shape (*batch,), int.
    """

    learner: KalmanState
    steps: Labels


@dataclass(frozen=True)
class FixedJacobian:
    """Initial Jacobian J_theta(0), estimated from the first moves and never updated; J_t = 0.

    Args:
        learner: Filter of the first moves.
        learning_steps: Number of its steps: the moves of the controller's `Excitation` and the frame after the last.
    """

    learner: KalmanJacobian = field(default_factory=KalmanJacobian)
    learning_steps: int = 7

    def initial(self, measurement: ServoMeasurement) -> FixedState:
        """Return the state before the first move. Raises ValueError as the learner does."""
        return FixedState(self.learner.initial(measurement), np.zeros(np.shape(measurement.time), dtype=np.int64))

    def step(self, state: FixedState, measurement: ServoMeasurement) -> tuple[FixedState, LinearEstimate]:
        """Process one measurement. Raises ValueError as the learner does."""
        learned, _ = self.learner.step(state.learner, measurement)
        alignment, increment = self.learner.alignment.step(state.learner.alignment, measurement)
        kept = state.learner._replace(alignment=alignment)
        learner = select_rows(state.steps < self.learning_steps, learned, kept)
        jacobian = learner.jacobian.copy()
        jacobian[..., -1] = 0.0
        silent = np.zeros(state.steps.shape)
        estimate = present_estimate(alignment.frame_features, jacobian, increment, measurement.goal, silent, silent)
        return FixedState(learner, state.steps + 1), estimate


class OracleState(NamedTuple):
    """State of `OracleJacobian`."""

    alignment: AlignmentState


@dataclass(frozen=True)
class OracleJacobian:
    """Analytic total Jacobian of the present, on the same features as all other agents; privileged.

    Args:
        alignment: Compensates the age of the newest frame.
    """

    alignment: Alignment = field(default_factory=Alignment)

    def initial(self, measurement: ServoMeasurement) -> OracleState:
        """Return the state before the first step. Raises ValueError as `Alignment` does."""
        return OracleState(self.alignment.initial(measurement))

    def step(self, state: OracleState, measurement: Any) -> tuple[OracleState, LinearEstimate]:
        """Process a measurement with `true_jacobian`, shape (*batch, m, n + 1), px/rad and px/s."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        jacobian: Array = np.asarray(measurement.true_jacobian, dtype=np.float64)
        silent = np.zeros(np.shape(measurement.time))
        estimate = present_estimate(alignment.frame_features, jacobian, increment, measurement.goal, silent, silent)
        return OracleState(alignment), estimate
