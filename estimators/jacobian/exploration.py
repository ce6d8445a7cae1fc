"""Exploratory moves that are chosen by what is still unknown, until the Jacobian is known well enough to serve."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.cautious import uncertainty
from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.excitation import Excite, Exciting
from servotrack.estimators.types import Array, Labels, Mask


class ExplorationState(NamedTuple):
    """State of an `Exploration`.

    Attributes:
        active: True while exploring. Shape (*batch,), bool.
        steps: Steps since exploration began. Shape (*batch,), int.
        moves: Moves of each joint. Shape (*batch, n), int.
        again: True where exploration has begun again. Shape (*batch,), bool.
        rest: Steps until each joint may be chosen again. Shape (*batch, n), int.
        amplitude: Size of the last move of each joint, 0 before the first one. Shape (*batch, n), rad.
        left: Rest of the present move. Shape (*batch, n), rad.
        center: Joint angles around which the moves go out and back. Shape (*batch, n), rad.
    """

    active: Mask
    steps: Labels
    moves: Labels
    again: Mask
    rest: Labels
    amplitude: Array
    left: Array
    center: Array


@dataclass(frozen=True)
class Exploration:
    """Exploratory moves of one joint at a time, always of the one whose part in the features is least known.

    The arm first rests for some frames, which shows the features' noise and the target's own motion. A move grows until
    its image stands out of the noise. Moves alternate around the start. Exploration ends when all directions are known.

    Args:
        resting: Frames to watch before the first move.
        signal: Image motion of a move, in standard deviations of the features' noise. Larger moves teach more and
            disturb more.
        largest_image_motion: Largest image motion of a move, root of the mean square of the features, px. It bounds
            `signal` where noise is large.
        known: Standard deviation of a column of J, as a share of a typical column, at which it counts as known. Smaller
            values explore longer.
        first_move: Size of the first move of a joint, rad.
        largest_move: Largest move of a joint, rad. It takes several periods if the joint is not faster.
        most_moves: Largest number of moves per joint.
        spacing: Steps between two moves of the same joint, in which their image arrives.
        period: Control period, s.
    """

    resting: int = 5
    signal: float = 40.0
    largest_image_motion: float = 80.0
    known: float = 0.3
    first_move: float = 0.02
    largest_move: float = 0.1
    most_moves: int = 4
    spacing: int = 3
    period: float = 0.05

    def __post_init__(self) -> None:
        for name in ("resting", "spacing"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be >= 0 steps, got {getattr(self, name)}")
        if self.most_moves < 1:
            raise ValueError(f"most_moves must be at least 1 per joint, got {self.most_moves}")
        for name in ("signal", "largest_image_motion", "known", "first_move", "largest_move", "period"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")

    def initial(self, measurement: ServoMeasurement) -> ExplorationState:
        """Return the state before the first step, in which exploration begins."""
        joint_angles = np.array(measurement.joint_angles, np.float64)
        batch = joint_angles.shape[:-1]
        return ExplorationState(
            active=np.ones(batch, np.bool_),
            steps=np.zeros(batch, np.int64),
            moves=np.zeros(joint_angles.shape, np.int64),
            again=np.zeros(batch, np.bool_),
            rest=np.zeros(joint_angles.shape, np.int64),
            amplitude=np.zeros(joint_angles.shape),
            left=np.zeros(joint_angles.shape),
            center=joint_angles,
        )

    def active(self, state: ExplorationState) -> Mask:
        """Rows that explore. Shape (*batch,), bool."""
        return state.active

    def step(
        self, state: ExplorationState, measurement: ServoMeasurement, estimate: ServoEstimate, wish: Excite
    ) -> tuple[ExplorationState, Exciting]:
        """Choose the next move.

        Args:
            state: State after the last step.
            measurement: Measurement of this step.
            estimate: Estimate of this step, with covariances.
            wish: Rows to restart, which do not rest first, and joints at their stops, which first move away from them.

        Returns:
            The new state and the moves.

        Raises:
            ValueError: An estimate without covariances.
        """
        covariance, variance = uncertainty(estimate)
        if not (state.active.any() or np.any(wish.restart)):
            return state, Exciting(state.active, np.zeros(state.center.shape))
        angles = np.ascontiguousarray(measurement.joint_angles, np.float64)
        *batch, m, d = estimate.jacobian.shape
        rows = math.prod(batch)
        flat = ExplorationState(*(part.reshape((rows, *part.shape[len(batch) :])) for part in state))
        results = _explore(
            flat,
            angles.reshape(rows, d - 1),
            np.ascontiguousarray(estimate.jacobian).reshape(rows, m, d),
            np.ascontiguousarray(covariance).reshape(rows, m, d, d),
            np.ascontiguousarray(variance).reshape(rows, m),
            np.ascontiguousarray(estimate.error).reshape(rows, m),
            Excite(
                np.ascontiguousarray(wish.restart, np.bool_).reshape(rows),
                np.ascontiguousarray(wish.blocked, np.float64).reshape(rows, d - 1),
                wish.max_joint_rate * self.period,
            ),
            (
                self.resting,
                self.signal,
                self.largest_image_motion,
                self.known,
                self.first_move,
                self.largest_move,
                self.most_moves,
                self.spacing,
            ),
        )
        shaped = [part.reshape((*batch, *part.shape[1:])) for part in results]
        new_state = ExplorationState(*shaped[:-1])
        return new_state, Exciting(new_state.active, shaped[-1] / self.period)


@njit(cache=True, nogil=True)
def _explore(before, angles, jacobians, covariances, variances, errors, wish, tuning):  # type: ignore[no-untyped-def]
    """`Exploration.step` over rows. Returns the fields of the state, then the motion of this period."""
    resting, signal, most_image, known, first_move, largest_move, most_moves, spacing = tuning
    restart, blocked, fastest = wish
    rows, n = angles.shape
    m = variances.shape[1]
    active, steps, moves = before.active.copy(), before.steps.copy(), before.moves.copy()
    rest, amplitude, left = before.rest.copy(), before.amplitude.copy(), before.left.copy()
    center, again = before.center.copy(), before.again.copy()
    motion = np.zeros((rows, n))
    columns, doubts = np.empty(n), np.empty(n)
    for row in range(rows):
        if restart[row] and not active[row]:
            active[row] = True
            steps[row] = resting
            moves[row] = 0
            rest[row] = 0
            left[row] = 0.0
            again[row] = True
            center[row] = angles[row]
        if not active[row]:
            continue
        steps[row] += 1
        if steps[row] <= resting:
            continue
        moving = False
        for j in range(n):
            if left[row, j] != 0.0:
                motion[row, j] = min(max(left[row, j], -fastest), fastest)
                left[row, j] -= motion[row, j]
                moving = True
        if moving:
            continue
        seen, deviation, error = 0, 0.0, 0.0
        columns[:] = 0.0
        doubts[:] = 0.0
        for i in range(m):
            if variances[row, i] < np.inf:
                seen += 1
                deviation += variances[row, i]
                error += errors[row, i] ** 2
                for j in range(n):
                    columns[j] += jacobians[row, i, j] ** 2 / variances[row, i]
                    doubts[j] += covariances[row, i, j, j] / variances[row, i]
        if seen == 0:
            continue
        deviation = np.sqrt(deviation / seen)
        typical, wanted = 0.0, min(signal, most_image / deviation)
        if again[row]:
            # Near the goal, the moves are no larger than what is left to go, as far as they stand out of the noise.
            wanted = min(wanted, max(0.25 * signal, np.sqrt(error / seen) / deviation))
        for j in range(n):
            columns[j] /= seen
            doubts[j] /= seen
            typical += columns[j] / n
        finished = True
        chosen, most = -1, 0.0
        for j in range(n):
            enough = moves[row, j] > 0 and doubts[j] < known * known * typical
            finished = finished and (enough or moves[row, j] >= most_moves)
            rest[row, j] = max(rest[row, j] - 1, 0)
            if rest[row, j] == 0 and not enough and moves[row, j] < most_moves:
                # Joints that never moved come first, in their order.
                doubt = doubts[j] if moves[row, j] > 0 else np.inf
                if doubt > most:
                    chosen, most = j, doubt
        if finished:
            active[row] = False
            continue
        if chosen < 0:
            continue
        j = chosen
        size = first_move
        if moves[row, j] > 0:
            # The response to the moves so far, as far as it is known.
            response = np.sqrt(columns[j])
            certain = columns[j] > doubts[j]
            size = wanted / response if certain else 2.0 * amplitude[row, j]
        elif typical > 0.0:
            size = wanted / np.sqrt(typical)
        size = min(max(size, 0.25 * first_move), largest_move)
        away = angles[row, j] - center[row, j]
        sign = -1.0 if away > 0.25 * size else 1.0
        if blocked[row, j] != 0.0:
            sign = -blocked[row, j]
        motion[row, j] = sign * min(size, fastest)
        left[row, j] = sign * size - motion[row, j]
        amplitude[row, j] = size
        moves[row, j] += 1
        rest[row, j] = spacing
    return active, steps, moves, again, rest, amplitude, left, center, motion
