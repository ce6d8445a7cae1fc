"""Small exploratory moves that excite all columns of the Jacobian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.types import Array, Labels, Mask


class Excite(NamedTuple):
    """Wishes of the controller for the next exploratory move.

    Attributes:
        restart: True for rows that begin to explore again. Shape (*batch,), bool.
        blocked: Direction, +1 or -1, in which a joint is at its stop; else 0. Shape (*batch, n).
        max_joint_rate: Limit of each joint rate, rad/s.
    """

    restart: Mask
    blocked: Array
    max_joint_rate: float


class Exciting(NamedTuple):
    """Exploratory moves of one step.

    Attributes:
        active: True for rows that explore. Shape (*batch,), bool.
        joint_rate: Joint rates of these rows. Shape (*batch, n), rad/s.
    """

    active: Mask
    joint_rate: Array


class ExploratoryMoves(Protocol):
    """Interface of `Excitation` and `Exploration`."""

    def initial(self, measurement: ServoMeasurement) -> Any:
        """Return the state before the first step, in which exploration begins."""

    def active(self, state: Any) -> Mask:
        """Rows that explore. Shape (*batch,), bool."""

    def step(
        self, state: Any, measurement: ServoMeasurement, estimate: ServoEstimate, wish: Excite
    ) -> tuple[Any, Exciting]:
        """Return the new state and the moves of this step."""


class ExcitationState(NamedTuple):
    """State of an `Excitation`.

    Attributes:
        move: Index of the next move; exploration ends at `Excitation.steps`. Shape (*batch,), int.
        direction: Direction of each joint in outward moves, +1 or -1. Shape (*batch, n).
    """

    move: Labels
    direction: Array


@dataclass(frozen=True)
class Excitation:
    """Exploratory moves of one joint at a time: first all joints outward, then all back, and so on.

    The moves outward and back separate a joint's column from the target's motion: the sum of the two changes of the
    features is J_t dt alone.

    Args:
        steps: Number of moves; 2 n of them excite every column of an n-joint arm twice. 0 disables exploration.
        amplitude: Size of one move, rad. Larger moves stand out better from the noise and disturb the servo more.
        period: Control period, s.
    """

    steps: int = 6
    amplitude: float = 0.04
    period: float = 0.05

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ValueError(f"steps must be >= 0, got {self.steps}")
        for name, value in (("amplitude", self.amplitude), ("period", self.period)):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")

    def initial(self, measurement: ServoMeasurement) -> ExcitationState:
        """Return the state before the first move."""
        shape = np.shape(measurement.joint_angles)
        return ExcitationState(np.zeros(shape[:-1], dtype=np.int64), np.ones(shape))

    def active(self, state: ExcitationState) -> Mask:
        """Rows that explore. Shape (*batch,), bool."""
        return state.move < self.steps

    def step(
        self, state: ExcitationState, measurement: ServoMeasurement, estimate: ServoEstimate, wish: Excite
    ) -> tuple[ExcitationState, Exciting]:
        """Return the next move; neither measurement nor estimate are read.

        Args:
            state: State after the last step.
            measurement: Measurement of this step.
            estimate: Estimate of this step.
            wish: Rows to restart, and joints at their stops, which explore away from them.

        Returns:
            The new state and the moves.
        """
        move = np.where(wish.restart, 0, state.move)
        turned = wish.restart[..., None] & (wish.blocked != 0.0)
        direction = np.where(turned, -wish.blocked, state.direction)
        probing = move < self.steps
        exciting = Exciting(probing, self.rate(move, direction))
        return ExcitationState(np.where(probing, move + 1, move), direction), exciting

    def rate(self, move: Labels, direction: Array) -> Array:
        """Compute the joint rates of one move.

        Args:
            move: Index of the move, from 0. Shape (*batch,).
            direction: Outward direction of each joint, +1 or -1. Shape (*batch, n).

        Returns:
            Joint rates. Shape (*batch, n), rad/s.
        """
        joints = direction.shape[-1]
        way = np.where((move // joints) % 2 == 0, 1.0, -1.0)
        chosen = np.arange(joints) == (move % joints)[..., None]
        return np.where(chosen, way[..., None] * direction * (self.amplitude / self.period), 0.0)
