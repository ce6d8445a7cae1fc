"""Jacobian estimators that only serve as anchors: one stops learning after its first moves, one is told the truth."""

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
        learner: State of the filter that learns from the exploratory moves; only its alignment goes on changing later.
        steps: Steps so far. Shape (*batch,), int.
    """

    learner: KalmanState
    steps: Labels


@dataclass(frozen=True)
class FixedJacobian:
    """J_theta(0), found from the first moves and never updated; J_t = 0, for what the target did then is no guide.

    Args:
        learner: Filter that sees the first moves.
        learning_steps: How many steps it sees; the moves of the controller's `Excitation` and the frame after the last.
    """

    learner: KalmanJacobian = field(default_factory=KalmanJacobian)
    learning_steps: int = 7

    def initial(self, measurement: ServoMeasurement) -> FixedState:
        """State before the first move. Raises ValueError as the learner does."""
        return FixedState(self.learner.initial(measurement), np.zeros(np.shape(measurement.time), dtype=np.int64))

    def step(self, state: FixedState, measurement: ServoMeasurement) -> tuple[FixedState, LinearEstimate]:
        """Fold one measurement in. Raises ValueError as the learner does."""
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
    """The analytic total Jacobian of the present, on the same features as everybody else; privileged.

    Args:
        alignment: Bridges the age of the newest frame.
    """

    alignment: Alignment = field(default_factory=Alignment)

    def initial(self, measurement: ServoMeasurement) -> OracleState:
        """State before the first step. Raises ValueError as `Alignment` does."""
        return OracleState(self.alignment.initial(measurement))

    def step(self, state: OracleState, measurement: Any) -> tuple[OracleState, LinearEstimate]:
        """Fold in a measurement that carries `true_jacobian`, shape (*batch, m, n + 1), px/rad and px/s."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        jacobian: Array = np.asarray(measurement.true_jacobian, dtype=np.float64)
        silent = np.zeros(np.shape(measurement.time))
        estimate = present_estimate(alignment.frame_features, jacobian, increment, measurement.goal, silent, silent)
        return OracleState(alignment), estimate
