"""Velocity of a goal that moves smoothly; a goal that is set anew has none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
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
    rows, m = state.time.size, goal.shape[-1]
    change, velocity = _velocities(
        state.goal.reshape(rows, m),
        state.change.reshape(rows, m),
        state.time.reshape(rows),
        np.ascontiguousarray(goal).reshape(rows, m),
        np.ascontiguousarray(time).reshape(rows),
    )
    return GoalState(goal.copy(), change.reshape(goal.shape), time.copy()), velocity.reshape(goal.shape)


@njit(cache=True, nogil=True)
def _velocities(goals, changes, times, goal, time):  # type: ignore[no-untyped-def]
    """Return the changes to keep and the velocities of rows, see `goal_velocity`. Shapes (rows, m)."""
    rows, m = goal.shape
    kept, velocity = changes.copy(), np.zeros((rows, m))
    for row in range(rows):
        passed = time[row] - times[row]
        if not passed > 0.0:
            continue
        before, differs = 0.0, 0.0
        for i in range(m):
            kept[row, i] = goal[row, i] - goals[row, i]
            before += changes[row, i] ** 2
            differs += (kept[row, i] - changes[row, i]) ** 2
        if differs <= 0.25 * before:
            for i in range(m):
                velocity[row, i] = kept[row, i] / passed
    return kept, velocity
