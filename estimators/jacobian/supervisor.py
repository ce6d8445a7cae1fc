"""Notices that a servo loop has gone bad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.laws import finite_or_zero
from servotrack.estimators.types import Array, Labels, Mask


class SupervisorState(NamedTuple):
    """What the supervisor remembers.

    Attributes:
        symptoms: Steps with a symptom, less the steps without. Shape (*batch,), int.
        error_norm: Length of the estimated error at the last frame. Shape (*batch,), px.
        surprise: Running mean of the estimator's surprise. Shape (*batch,).
        joint_angles: At the last step. Shape (*batch, n), rad.
        blocked: Steps for which each joint has not followed its command. Shape (*batch, n), int.
        unseen: Steps since the last usable frame. Shape (*batch,), int.
        last_seen_joints: Joint angles when the target was last seen. Shape (*batch, n), rad.
    """

    symptoms: Labels
    error_norm: Array
    surprise: Array
    joint_angles: Array
    blocked: Labels
    unseen: Labels
    last_seen_joints: Array


class Verdict(NamedTuple):
    """What the supervisor says at one step.

    Attributes:
        excite: Whether the estimate has gone bad and wants exploratory moves. Shape (*batch,), bool.
        lost: Whether the target has been out of view for too long to trust the prediction. Shape (*batch,), bool.
    """

    excite: Mask
    lost: Mask


@dataclass(frozen=True)
class Supervisor:
    """Counts the steps on which something is wrong; once they outnumber the others by `patience`, it speaks up.

    Wrong is: the estimator is surprised on average; J_theta is (nearly) singular; the error is large and does not
    shrink; the error is large and a joint does not follow its command, which at a stop means that it is driven by a
    Jacobian that no motion corrects any more.

    Args:
        patience: How far the bad steps must outnumber the good ones.
        surprise_limit: Bound of the running mean of the surprise (1 for a consistent filter).
        surprise_memory: Share of the old mean kept at every frame, in [0, 1).
        condition_limit: Bound of the condition number of J_theta.
        large_error: Error from which on it has to shrink, px.
        shrinking: Error over the last frame's error that counts as shrinking, at most 1.
        least_motion: Commanded motion in one step from which on a joint is expected to follow, rad.
        followed: Share of the commanded motion that counts as following.
        blocked_limit: Steps without following after which a joint counts as blocked.
        unseen_limit: Steps without the target after which it counts as lost.
    """

    patience: int = 10
    surprise_limit: float = 12.0
    surprise_memory: float = 0.8
    condition_limit: float = 300.0
    large_error: float = 60.0
    shrinking: float = 0.99
    least_motion: float = 0.01
    followed: float = 0.2
    blocked_limit: int = 3
    unseen_limit: int = 10

    def __post_init__(self) -> None:
        for name, count in (
            ("patience", self.patience),
            ("blocked_limit", self.blocked_limit),
            ("unseen_limit", self.unseen_limit),
        ):
            if count < 1:
                raise ValueError(f"{name} must be at least 1 step, got {count}")
        if not 0.0 <= self.surprise_memory < 1.0:
            raise ValueError(f"surprise_memory must be in [0, 1), got {self.surprise_memory}")

    def initial(self, measurement: ServoMeasurement) -> SupervisorState:
        """Nothing wrong so far."""
        joint_angles = np.array(measurement.joint_angles, dtype=np.float64)
        batch = joint_angles.shape[:-1]
        return SupervisorState(
            symptoms=np.zeros(batch, dtype=np.int64),
            error_norm=np.zeros(batch),
            surprise=np.ones(batch),
            joint_angles=joint_angles,
            blocked=np.zeros(joint_angles.shape, dtype=np.int64),
            unseen=np.zeros(batch, dtype=np.int64),
            last_seen_joints=joint_angles.copy(),
        )

    def step(
        self, state: SupervisorState, measurement: ServoMeasurement, estimate: ServoEstimate, commanded: Array
    ) -> tuple[SupervisorState, Verdict]:
        """Look at one step.

        Args:
            state: As of the last step.
            measurement: Of now.
            estimate: Of now.
            commanded: Joint motion commanded at the last step. Shape (*batch, n), rad.

        Returns:
            The new state and the verdict.
        """
        joint_angles = np.asarray(measurement.joint_angles, dtype=np.float64)
        visible = np.asarray(measurement.visible, dtype=np.bool_)
        unseen = np.where(visible, 0, state.unseen + 1)

        error_norm = np.where(visible, np.sqrt(np.sum(estimate.error**2, axis=-1)), state.error_norm)
        large = error_norm > self.large_error
        growing = error_norm > self.shrinking * state.error_norm
        surprise = np.where(
            visible,
            self.surprise_memory * state.surprise + (1.0 - self.surprise_memory) * estimate.surprise,
            state.surprise,
        )
        moved = joint_angles - state.joint_angles
        stuck = (np.abs(commanded) > self.least_motion) & (
            moved * np.sign(commanded) < self.followed * np.abs(commanded)
        )
        blocked = np.where(stuck, state.blocked + 1, 0)

        bad = (large & growing) | (surprise > self.surprise_limit) | self._ill_conditioned(estimate)
        # A joint that rests against its stop while the error is small only waits for the target to come back.
        bad |= large & (blocked >= self.blocked_limit).any(axis=-1)
        change = np.where(bad, 1, -1)
        # Without a frame there is nothing new to judge by.
        symptoms = np.where(visible, np.clip(state.symptoms + change, 0, self.patience), state.symptoms)
        new_state = SupervisorState(
            symptoms=symptoms,
            error_norm=error_norm,
            surprise=surprise,
            joint_angles=joint_angles,
            blocked=blocked,
            unseen=unseen,
            last_seen_joints=np.where(visible[..., None], joint_angles, state.last_seen_joints),
        )
        return new_state, Verdict(visible & (symptoms >= self.patience), unseen >= self.unseen_limit)

    def _ill_conditioned(self, estimate: ServoEstimate) -> Mask:
        values = np.linalg.svd(finite_or_zero(estimate.jacobian[..., :-1]), compute_uv=False)
        return values[..., 0] >= self.condition_limit * values[..., -1]
