"""Supervision of a servo loop: detect a wrong Jacobian estimate and a lost target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.laws import finite_or_zero
from servotrack.estimators.types import Array, Labels, Mask


class SupervisorState(NamedTuple):
    """State of a `Supervisor`.

    Attributes:
        symptoms: Number of steps with a symptom minus those without, from 0 to `symptom_limit`. Shape (*batch,), int.
        error_norm: Norm of the estimated error at the last frame. Shape (*batch,), px.
        nis: Running mean of the estimator's normalized innovation squared, divided by m. Shape (*batch,).
        joint_angles: Joint angles at the last step. Shape (*batch, n), rad.
        blocked: Number of consecutive steps in which each joint has not followed its command. Shape (*batch, n), int.
        unseen: Steps since the last frame that showed the target. Shape (*batch,), int.
        last_seen_joints: Joint angles when the target was last seen. Shape (*batch, n), rad.
    """

    symptoms: Labels
    error_norm: Array
    nis: Array
    joint_angles: Array
    blocked: Labels
    unseen: Labels
    last_seen_joints: Array


class Verdict(NamedTuple):
    """Decision of a `Supervisor` at one step.

    Attributes:
        excite: True if the estimate is wrong and needs exploratory moves. Shape (*batch,), bool.
        lost: True if the target has been out of view too long for a valid prediction. Shape (*batch,), bool.
        blocked: Direction, +1 or -1, in which a joint was commanded and did not follow; else 0. Shape (*batch, n).
    """

    excite: Mask
    lost: Mask
    blocked: Array


@dataclass(frozen=True)
class Supervisor:
    """Detector of a wrong estimate: requests exploration when bad steps outnumber good ones by `symptom_limit`.

    A step is bad if one of these holds: the mean NIS is too large; J_theta is nearly singular; the error is large and
    does not shrink; the error is large and a joint does not follow its command. The last one means that the joint is
    at its stop, where no motion corrects the Jacobian.

    Args:
        symptom_limit: Number by which bad steps must outnumber good ones. Larger values explore later and less often.
        nis_limit: Largest running mean of the NIS divided by m, which is 1 for a consistent filter. Larger values
            tolerate a worse estimate.
        nis_memory: Share of the old mean kept at every frame, in [0, 1). Larger values average more frames.
        condition_limit: Condition number of J_theta from which it counts as singular.
        large_error: Error norm above which the error has to shrink, px.
        shrinking: Largest ratio of the error to the last frame's error that counts as shrinking, at most 1.
        least_motion: Commanded motion in one step above which a joint is expected to follow, rad.
        followed: Share of the commanded motion that counts as following, in [0, 1]. Larger values report a blocked
            joint sooner.
        blocked_limit: Consecutive steps without following after which a joint counts as blocked.
        unseen_limit: Steps without the target after which it counts as lost.
    """

    symptom_limit: int = 10
    nis_limit: float = 12.0
    nis_memory: float = 0.8
    condition_limit: float = 300.0
    large_error: float = 60.0
    shrinking: float = 0.99
    least_motion: float = 0.01
    followed: float = 0.2
    blocked_limit: int = 3
    unseen_limit: int = 10

    def __post_init__(self) -> None:
        for name, count in (
            ("symptom_limit", self.symptom_limit),
            ("blocked_limit", self.blocked_limit),
            ("unseen_limit", self.unseen_limit),
        ):
            if count < 1:
                raise ValueError(f"{name} must be at least 1 step, got {count}")
        if not 0.0 <= self.nis_memory < 1.0:
            raise ValueError(f"nis_memory must be in [0, 1), got {self.nis_memory}")

    def initial(self, measurement: ServoMeasurement) -> SupervisorState:
        """Return the state before the first step, without symptoms."""
        joint_angles = np.array(measurement.joint_angles, dtype=np.float64)
        batch = joint_angles.shape[:-1]
        return SupervisorState(
            symptoms=np.zeros(batch, dtype=np.int64),
            error_norm=np.zeros(batch),
            nis=np.ones(batch),
            joint_angles=joint_angles,
            blocked=np.zeros(joint_angles.shape, dtype=np.int64),
            unseen=np.zeros(batch, dtype=np.int64),
            last_seen_joints=joint_angles.copy(),
        )

    def renewed(self, state: SupervisorState, measurement: ServoMeasurement) -> SupervisorState:
        """Return the state with which a new exploration begins: that of a new run."""
        return self.initial(measurement)

    def step(
        self,
        state: SupervisorState,
        measurement: ServoMeasurement,
        estimate: ServoEstimate,
        commanded: Array,
        exploring: Mask | None = None,
    ) -> tuple[SupervisorState, Verdict]:
        """Judge one step.

        Args:
            state: State after the last step.
            measurement: Measurement of this step.
            estimate: Estimate of this step.
            commanded: Joint motion commanded at the last step. Shape (*batch, n), rad.
            exploring: Rows that explore; not read.

        Returns:
            The new state and the verdict.
        """
        joint_angles = np.asarray(measurement.joint_angles, dtype=np.float64)
        visible = np.asarray(measurement.visible, dtype=np.bool_)
        unseen = np.where(visible, 0, state.unseen + 1)

        error_norm = np.where(visible, np.sqrt(np.sum(estimate.error**2, axis=-1)), state.error_norm)
        large = error_norm > self.large_error
        growing = error_norm > self.shrinking * state.error_norm
        nis = np.where(
            visible,
            self.nis_memory * state.nis + (1.0 - self.nis_memory) * estimate.nis,
            state.nis,
        )
        moved = joint_angles - state.joint_angles
        stuck = (np.abs(commanded) > self.least_motion) & (
            moved * np.sign(commanded) < self.followed * np.abs(commanded)
        )
        blocked = np.where(stuck, state.blocked + 1, 0)

        bad = (large & growing) | (nis > self.nis_limit) | self._ill_conditioned(estimate)
        # With a small error, a joint at its stop is no symptom: the target may come back into reach.
        bad |= large & (blocked >= self.blocked_limit).any(axis=-1)
        change = np.where(bad, 1, -1)
        # A step without a frame carries no new evidence.
        symptoms = np.where(visible, np.clip(state.symptoms + change, 0, self.symptom_limit), state.symptoms)
        new_state = SupervisorState(
            symptoms=symptoms,
            error_norm=error_norm,
            nis=nis,
            joint_angles=joint_angles,
            blocked=blocked,
            unseen=unseen,
            last_seen_joints=np.where(visible[..., None], joint_angles, state.last_seen_joints),
        )
        away = np.where(blocked > 0, np.sign(commanded), 0.0)
        return new_state, Verdict(visible & (symptoms >= self.symptom_limit), unseen >= self.unseen_limit, away)

    def _ill_conditioned(self, estimate: ServoEstimate) -> Mask:
        values = np.linalg.svd(finite_or_zero(estimate.jacobian[..., :-1]), compute_uv=False)
        return values[..., 0] >= self.condition_limit * values[..., -1]
