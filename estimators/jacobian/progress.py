"""Supervision by progress: a servo that no longer comes nearer explores again, less and less often."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.cautious import uncertainty
from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.supervisor import Verdict
from servotrack.estimators.types import Array, Labels, Mask


class ProgressState(NamedTuple):
    """State of a `ProgressSupervisor`.

    Attributes:
        best: Smallest error since the last exploration, in standard deviations. Shape (*batch,).
        stalled: Steps since the error became clearly smaller. Shape (*batch,), int.
        patience: Steps without progress after which the arm explores. Shape (*batch,), int.
        turned: Way of each joint since then. Shape (*batch, n), rad.
        joint_angles: Joint angles at the last step. Shape (*batch, n), rad.
        blocked: Consecutive steps in which each joint has not followed its command. Shape (*batch, n), int.
        unseen: Steps since the last frame that showed the target. Shape (*batch,), int.
        last_seen_joints: Joint angles when the target was last seen. Shape (*batch, n), rad.
    """

    best: Array
    stalled: Labels
    patience: Labels
    turned: Array
    joint_angles: Array
    blocked: Labels
    unseen: Labels
    last_seen_joints: Array


@dataclass(frozen=True)
class ProgressSupervisor:
    """Detector of a servo that makes no progress: the error is significant and has not become smaller for a while.

    Progress is counted in standard deviations of the error, and not while the arm explores. After every exploration
    the patience doubles until the goal is reached, so that a goal out of reach does not keep the arm exploring.

    Args:
        settled: Error, root of the mean square in standard deviations, below which the goal counts as reached. Larger
            values tolerate a lasting error.
        tolerance: Error, root of the mean square in the features' unit, that is near enough in any case: play, sag and
            encoders leave one that no exploration removes. A number or shape (m,), px.
        progress: Share by which the error must fall below its best to count as progress, in (0, 1).
        patience: Steps without progress after which the arm explores again. Larger values explore later.
        max_excursion: Way of a joint without progress after which the arm explores again in any case: a servo with a
            wrong Jacobian turns on and on. A number or shape (n,), rad; other units for joints that slide. Larger
            values allow longer ways around.
        least_motion: Commanded motion in one step above which a joint is expected to follow, rad.
        followed: Share of the commanded motion that counts as following, in [0, 1].
        blocked_limit: Consecutive steps without following after which a joint counts as blocked.
        unseen_limit: Steps without the target after which it counts as lost.
    """

    settled: float = 4.0
    tolerance: float | tuple[float, ...] = 3.0
    progress: float = 0.2
    patience: int = 40
    max_excursion: float | tuple[float, ...] = 3.0
    least_motion: float = 0.005
    followed: float = 0.2
    blocked_limit: int = 5
    unseen_limit: int = 10

    def __post_init__(self) -> None:
        for name in ("patience", "blocked_limit", "unseen_limit"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1 step, got {getattr(self, name)}")
        if not 0.0 < self.settled < np.inf:
            raise ValueError(f"settled must be finite and > 0 standard deviations, got {self.settled}")
        if not (np.asarray(self.tolerance, np.float64) >= 0.0).all():
            raise ValueError(f"tolerance must be >= 0 in the features' unit, got {self.tolerance}")
        if not (np.asarray(self.max_excursion, np.float64) > 0.0).all():
            raise ValueError(f"max_excursion must be > 0 rad, or infinite for none, got {self.max_excursion}")
        if not 0.0 < self.progress < 1.0:
            raise ValueError(f"progress must be in (0, 1), got {self.progress}")

    def initial(self, measurement: ServoMeasurement) -> ProgressState:
        """Return the state before the first step."""
        joint_angles = np.array(measurement.joint_angles, dtype=np.float64)
        batch = joint_angles.shape[:-1]
        return ProgressState(
            best=np.full(batch, np.inf),
            stalled=np.zeros(batch, dtype=np.int64),
            patience=np.full(batch, self.patience),
            turned=np.zeros(joint_angles.shape),
            joint_angles=joint_angles,
            blocked=np.zeros(joint_angles.shape, dtype=np.int64),
            unseen=np.zeros(batch, dtype=np.int64),
            last_seen_joints=joint_angles.copy(),
        )

    def renewed(self, state: ProgressState, measurement: ServoMeasurement) -> ProgressState:
        """Return the state with which a new exploration begins: it keeps its patience, and where the target was."""
        return state

    def step(
        self,
        state: ProgressState,
        measurement: ServoMeasurement,
        estimate: ServoEstimate,
        commanded: Array,
        exploring: Mask,
    ) -> tuple[ProgressState, Verdict]:
        """Judge one step.

        Args:
            state: State after the last step.
            measurement: Measurement of this step.
            estimate: Estimate of this step, with the variance of its error.
            commanded: Joint motion commanded at the last step. Shape (*batch, n), rad.
            exploring: Rows that explore. Shape (*batch,), bool.

        Returns:
            The new state and the verdict.

        Raises:
            ValueError: An estimate without covariances.
        """
        variance = uncertainty(estimate)[1]
        joint_angles = np.asarray(measurement.joint_angles, dtype=np.float64)
        visible = np.asarray(measurement.visible, dtype=np.bool_)
        seen = np.asarray(visible.any(axis=-1)) if visible.ndim == joint_angles.ndim else visible

        known = variance < np.inf
        least = np.maximum(variance, (np.asarray(self.tolerance, np.float64) / self.settled) ** 2)
        squares = np.where(known, estimate.error**2 / least, 0.0).sum(axis=-1)
        error = np.sqrt(squares / np.maximum(known.sum(axis=-1), 1))
        near = (error < self.settled) & known.any(axis=-1)
        better = seen & ~exploring & (error < (1.0 - self.progress) * state.best)
        best = np.where(exploring, np.inf, np.where(better, error, state.best))
        # A step without a frame carries no new evidence.
        counted = seen & ~exploring & ~near & ~better
        stalled = np.where(exploring | near | better, 0, state.stalled + counted)
        rested = exploring | near | better
        way = np.abs(np.remainder(joint_angles - state.joint_angles + np.pi, 2.0 * np.pi) - np.pi)
        turned = np.where(rested[..., None], 0.0, state.turned + way)
        excite = (stalled >= state.patience) | (turned > np.asarray(self.max_excursion)).any(axis=-1)
        patience = np.where(near, self.patience, np.where(excite, 2 * state.patience, state.patience))

        stuck = (np.abs(commanded) > self.least_motion) & (
            (joint_angles - state.joint_angles) * np.sign(commanded) < self.followed * np.abs(commanded)
        )
        blocked = np.where(stuck, state.blocked + 1, 0)
        unseen = np.where(seen, 0, state.unseen + 1)
        new_state = ProgressState(
            best=best,
            stalled=np.where(excite, 0, stalled),
            patience=patience,
            turned=np.where(excite[..., None], 0.0, turned),
            joint_angles=joint_angles,
            blocked=blocked,
            unseen=unseen,
            last_seen_joints=np.where(seen[..., None], joint_angles, state.last_seen_joints),
        )
        away = np.where(blocked >= self.blocked_limit, np.sign(commanded), 0.0)
        return new_state, Verdict(excite, unseen >= self.unseen_limit, away)
