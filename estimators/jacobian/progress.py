"""Supervision by progress: a servo that no longer comes nearer explores again, less and less often."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
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
        slack: Error of the joints that is near enough in any case, rad: what it moves a feature by its row of J adds to
            `tolerance` where that is smaller, as for cameras of many pixels. Larger values tolerate a lasting error.
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
    slack: float = 0.003
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
        for name in ("tolerance", "max_excursion"):
            value = np.asarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, float(value) if value.ndim == 0 else tuple(value.tolist()))
        if not 0.0 <= self.slack < np.inf:
            raise ValueError(f"slack must be finite and >= 0 rad, got {self.slack}")
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
        joint_angles = np.ascontiguousarray(measurement.joint_angles, np.float64)
        visible = np.asarray(measurement.visible, dtype=np.bool_)
        *batch, n = joint_angles.shape
        m, rows = variance.shape[-1], math.prod(batch)
        groups = visible.shape[-1] if visible.ndim == joint_angles.ndim else 1
        parts, away, excite, lost = _judged(
            ProgressState(*(part.reshape((rows, *part.shape[len(batch) :])) for part in state)),
            joint_angles.reshape(rows, n),
            np.ascontiguousarray(visible).reshape(rows, groups),
            np.ascontiguousarray(estimate.error).reshape(rows, m),
            np.ascontiguousarray(variance).reshape(rows, m),
            np.ascontiguousarray(estimate.jacobian).reshape(rows, m, n + 1),
            np.ascontiguousarray(commanded).reshape(rows, n),
            np.ascontiguousarray(exploring).reshape(rows),
            _each(self.tolerance, m),
            _each(self.max_excursion, n),
            (
                self.settled,
                self.slack,
                self.progress,
                self.patience,
                self.least_motion,
                self.followed,
                self.blocked_limit,
                self.unseen_limit,
            ),
        )
        new_state = ProgressState(*(part.reshape((*batch, *part.shape[1:])) for part in parts))
        return new_state, Verdict(excite.reshape(batch), lost.reshape(batch), away.reshape(joint_angles.shape))


@functools.lru_cache(maxsize=256)
def _each(value: float | tuple[float, ...], count: int) -> Array:
    """Return a number for each feature or joint."""
    return np.broadcast_to(np.asarray(value, np.float64), count).copy()


@njit(cache=True, nogil=True)
def _judged(  # type: ignore[no-untyped-def]
    before, angles, visible, errors, variances, jacobians, commanded, exploring, tolerance, excursion, tuning
):
    """`ProgressSupervisor.step` over rows. Returns the fields of the state, then `away`, `excite` and `lost`."""
    settled, slack, progress, first_patience, least_motion, followed, blocked_limit, unseen_limit = tuning
    rows, n = angles.shape
    m = errors.shape[1]
    best, stalled, patience = before.best.copy(), before.stalled.copy(), before.patience.copy()
    turned, blocked, unseen = before.turned.copy(), before.blocked.copy(), before.unseen.copy()
    last_seen = before.last_seen_joints.copy()
    away, excite, lost = np.zeros((rows, n)), np.zeros(rows, np.bool_), np.zeros(rows, np.bool_)
    for row in range(rows):
        seen = False
        for i in range(visible.shape[1]):
            seen = seen or visible[row, i]
        squares, known = 0.0, 0
        for i in range(m):
            if variances[row, i] < np.inf:
                moved = 0.0
                for j in range(n):
                    moved += jacobians[row, i, j] ** 2
                least = max(tolerance[i] ** 2, slack * slack * moved) / settled**2
                squares += errors[row, i] ** 2 / max(variances[row, i], least)
                known += 1
        error = np.sqrt(squares / max(known, 1))
        near = error < settled and known > 0
        better = seen and not exploring[row] and error < (1.0 - progress) * best[row]
        rested = exploring[row] or near or better
        best[row] = np.inf if exploring[row] else error if better else best[row]
        # A step without a frame carries no new evidence.
        stalled[row] = 0 if rested else stalled[row] + int(seen)
        again = stalled[row] >= patience[row]
        for j in range(n):
            change = angles[row, j] - before.joint_angles[row, j]
            way = abs((change + np.pi) % (2.0 * np.pi) - np.pi)
            turned[row, j] = 0.0 if rested else turned[row, j] + way
            again = again or turned[row, j] > excursion[j]
            wanted = commanded[row, j]
            stuck = abs(wanted) > least_motion and change * np.sign(wanted) < followed * abs(wanted)
            blocked[row, j] = blocked[row, j] + 1 if stuck else 0
            if blocked[row, j] >= blocked_limit:
                away[row, j] = np.sign(wanted)
            if seen:
                last_seen[row, j] = angles[row, j]
        patience[row] = first_patience if near else 2 * patience[row] if again else patience[row]
        if again:
            stalled[row] = 0
            turned[row] = 0.0
        unseen[row] = 0 if seen else unseen[row] + 1
        excite[row], lost[row] = again, unseen[row] >= unseen_limit
    return (best, stalled, patience, turned, angles.copy(), blocked, unseen, last_seen), away, excite, lost
