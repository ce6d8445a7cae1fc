"""What every agent does with its memory: it begins where an episode begins, and goes on elsewhere."""

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
    """The state that `predict` is to go on from.

    Args:
        state: What the last call returned; None starts anew.
        episode_start: Rows that start anew. The shape of the batch, or a scalar.
        batch: Leading axes of the state's arrays.
        initial: Makes the state of a new episode; called only where some row starts.

    Returns:
        Rows of a new state where an episode starts, of the old one elsewhere.
    """
    if state is None:
        return initial()
    if episode_start is None or not np.any(episode_start):
        return state
    return select_rows(np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), batch), initial(), state)
