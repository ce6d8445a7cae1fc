"""Estimate of a rigid chain: exact predictions, and the motion to the goal."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servotrack.estimators.jacobian.chain_goal import chain_goal_rows
from servotrack.estimators.jacobian.chain_kernel import chain_feature_rows
from servotrack.estimators.jacobian.contract import LinearEstimate
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class ChainEstimate(LinearEstimate):
    """Estimate with the exact prediction of a chain for features that follow it, and the linear one for the others.

    Attributes:
        chained: True for features that come from the chain. Shape (*batch, m), bool.
        parameters: Parameters of the chain, see `chain_kernel`. Shape (*batch, N).
        reverse: True if the last joint is next to the camera. Shape (*batch,), bool.
        focal: Unit of the focal length. Shape (*batch,), px.
        angles: Present joint angles, from those of the first frame. Shape (*batch, n), rad.
    """

    chained: Mask = field(kw_only=True)
    parameters: Array = field(kw_only=True)
    reverse: Mask = field(kw_only=True)
    focal: Array = field(kw_only=True)
    angles: Array = field(kw_only=True)

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Predict the error after a motion. Arguments as in `ServoEstimate.predict_error`."""
        linear = LinearEstimate.predict_error(self, joint_motion, duration)
        motion = np.asarray(joint_motion, np.float64)
        points = self.error.shape[-1] // 2
        before = chain_feature_rows(self.parameters, self.angles, self.reverse, self.focal, points)
        after = chain_feature_rows(self.parameters, self.angles + motion, self.reverse, self.focal, points)
        return np.where(self.chained, self.error + (after - before), linear)

    def motion_to_goal(self, low: Array | None = None, high: Array | None = None) -> tuple[Array, Array]:
        """Find the joint motion that brings all features of the chain to their goal.

        The search follows images between the present one and the goal's, turned and scaled about their center, so that
        it also finds goals half a turn away, at which the steps of a law in the image end in a retreat of the camera.

        Args:
            low: Least motion of each joint, such as lower limits minus present angles; None: unbounded. Shape
                (*batch, n), rad.
            high: Largest motion of each joint. Shape (*batch, n), rad.

        Returns:
            The motion, shape (*batch, n), rad, and the root mean square of the errors that it leaves, shape (*batch,),
            px: large where no posture within the bounds shows the goal, infinite where no feature follows the chain. A
            law in the image, with `error` and `jacobian`, is better where it exceeds both a few deviations of the noise
            and a quarter of the present errors.
        """
        *batch, n = self.angles.shape
        m, rows = self.error.shape[-1], self.reverse.size
        ends = []
        for value, default in ((low, -np.inf), (high, np.inf)):
            bound = np.full(n, default) if value is None else np.asarray(value, np.float64)
            ends.append(np.ascontiguousarray(np.broadcast_to(bound, self.angles.shape)).reshape(rows, n))
        now = chain_feature_rows(self.parameters, self.angles, self.reverse, self.focal, m // 2)
        chains = self.parameters.reshape(rows, -1), self.angles.reshape(rows, n), self.reverse.reshape(rows)
        motions, left = chain_goal_rows(
            (*chains, self.focal.reshape(rows)),
            (now - self.error).reshape(rows, m),
            self.chained.reshape(rows, m),
            (ends[0], ends[1]),
        )
        left = np.where(self.chained.reshape(rows, m).any(axis=-1), left, np.inf)
        return motions.reshape(*batch, n), left.reshape(self.reverse.shape)
