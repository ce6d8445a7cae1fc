"""The estimator for an arm of which nothing is known: a rigid chain with some play, or a Jacobian and no more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from servotrack.estimators.jacobian.adaptive import AdaptiveKalmanJacobian, AdaptiveState
from servotrack.estimators.jacobian.alignment import Alignment
from servotrack.estimators.jacobian.chain import ChainJacobian
from servotrack.estimators.jacobian.chain_bank import ChainBank
from servotrack.estimators.jacobian.contract import JacobianEstimator, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked


def chain_bank(
    plays: Sequence[float] = (0.0, 0.0087, 0.0175),
    moving: Sequence[float] = (0.0,),
    revolute: tuple[bool, ...] | None = None,
) -> ChainBank:
    """Create a bank of `ChainJacobian`s, each with an `AdaptiveKalmanJacobian` beside it, one per play of the gears.

    Play between encoder and link is what no calibration shows and what a servo trips over: near the goal, joints turn
    back and forth within it. Which play is right shows in the predicted features.

    Args:
        plays: Assumed plays of all joints, rad: none, half a degree and a degree. Computing time grows in proportion
            to their number.
        moving: The same, of chains whose target moves by itself.
        revolute: True for each joint that turns, False for those that slide; None: all turn. Shape (n,).
    """
    alignment = Alignment(revolute=revolute)
    chain = ChainJacobian(linear=AdaptiveKalmanJacobian(alignment=alignment), alignment=alignment, revolute=revolute)
    return ChainBank(chain, tuple(plays), tuple(moving))


@dataclass(frozen=True)
class AnyArm:
    """Estimator that reads from the first measurement what the features are.

    One entry of `ServoMeasurement.visible` per pair of features, for three pairs or more, says that the pairs are
    columns and rows of image points of one rigid body: a chain of rigid links explains them, which learns faster and
    knows hidden points. All others may be anything that depends on the joints.

    Args:
        points: Estimator for image points.
        features: Estimator for other features.
    """

    points: JacobianEstimator = field(default_factory=chain_bank)
    features: JacobianEstimator = field(default_factory=AdaptiveKalmanJacobian)

    row_covariances: ClassVar[bool] = True

    def initial(self, measurement: ServoMeasurement) -> Any:
        """State of the estimator that is chosen. Raises ValueError as that does."""
        shape = checked(measurement, each_feature=True).features.shape
        visible = np.shape(measurement.visible)
        points = len(visible) == len(shape) and shape[-1] == 2 * visible[-1] and visible[-1] >= 3
        return (self.points if points else self.features).initial(measurement)

    def step(self, state: Any, measurement: ServoMeasurement) -> tuple[Any, Any]:
        """Update with one measurement. Raises ValueError as the chosen estimator does."""
        return self._chosen(state).step(state, measurement)

    def forget(self, state: Any) -> Any:
        """Let the chosen estimator forget, if it can."""
        chosen: Any = self._chosen(state)
        return chosen.forget(state) if hasattr(chosen, "forget") else state

    def _chosen(self, state: Any) -> JacobianEstimator:
        return self.features if isinstance(state, AdaptiveState) else self.points
