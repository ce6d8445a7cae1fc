"""Velocity of a goal that moves smoothly; a goal that is set anew has none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.types import Array


class GoalState(NamedTuple):
    """Goal of the last step and its last change.

    Attributes:
        goal: Desired features. Shape (*batch, m), px.
        change: Change of the desired features in the last step. Shape (*batch, m), px.
        time: Time of the last step. Shape (*batch,), s.
    """

    goal: Array
    change: Array
    time: Array


def begin_goal(goal: Array, time: Array) -> GoalState:
    """State of a goal that has rested so far. Arguments as in `GoalState`."""
    return GoalState(goal.copy(), np.zeros_like(goal), time.copy())


def goal_velocity(state: GoalState, goal: Array, time: Array) -> tuple[GoalState, Array]:
    """Velocity of the goal, 0 where its change is not about that of the step before.

    Args:
        state: State after the last step.
        goal: Desired features. Shape (*batch, m), px.
        time: Present time. Shape (*batch,), s.

    Returns:
        The new state and the velocity. Shape (*batch, m), px/s.
    """
    change, passed = goal - state.goal, (time - state.time)[..., None]
    before = np.sum(state.change**2, axis=-1, keepdims=True)
    smooth = (np.sum((change - state.change) ** 2, axis=-1, keepdims=True) <= 0.25 * before) & (passed > 0.0)
    velocity = np.divide(change, passed, out=np.zeros_like(change), where=np.broadcast_to(smooth, change.shape))
    again = np.broadcast_to(passed > 0.0, change.shape)
    return GoalState(goal.copy(), np.where(again, change, state.change), time.copy()), velocity
