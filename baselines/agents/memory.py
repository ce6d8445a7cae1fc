"""Reset the rows of an agent's state whose episode starts, and keep the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Mask

State = TypeVar("State")


def remembered(
    state: State | None, episode_start: Mask | None, batch: tuple[int, ...], initial: Callable[[], State]
) -> State:
    """Return the state that `predict` continues from.

    Args:
        state: Result of the last call; None starts anew.
        episode_start: Rows that start anew. The shape of the batch, or a scalar.
        batch: Leading axes of the state's arrays.
        initial: Creates the state of a new episode; called only if some row starts.

    Returns:
        The state, with new rows for starting episodes and old rows for the others.
    """
    if state is None:
        return initial()
    if episode_start is None or not np.any(episode_start):
        return state
    return select_rows(np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), batch), initial(), state)
