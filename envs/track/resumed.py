"""Exact state of tracking worlds: their scenes do not depend on the answers, so they are drawn again from the seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State, entry, part, put, taken
from servotrack.estimators.types import Labels


def scored_state(world: Any, names: tuple[str, ...]) -> State:
    """Return the state of a world: `seeds` and `steps` of its rows, the scores `names`, and those of its scorer."""
    state = taken(world, ("seeds", "steps", *names))
    scorer = getattr(world, "scorer", None)
    return state if scorer is None else state | {f"scorer/{name}": value for name, value in scorer.get_state().items()}


def checked_rows(world: Any, state: Mapping[str, NDArray[Any]], longest: int) -> tuple[Labels, Labels]:
    """Return the rows' seeds and steps in a state.

    Args:
        world: World that is to be restored.
        state: State of `scored_state`.
        longest: Largest number of steps.

    Raises:
        ValueError: They are missing, or do not fit.
    """
    seeds = entry(state, "seeds", (world.count,), np.int64)
    steps = entry(state, "steps", (world.count,), np.int64)
    if seeds.min() < 0 or steps.min() < 0 or steps.max() > longest:
        raise ValueError(f"state's seeds must be at least 0 and its steps lie in 0 to {longest}, got {steps.tolist()}")
    return seeds, steps


def put_scores(world: Any, names: tuple[str, ...], state: Mapping[str, NDArray[Any]]) -> None:
    """Write the scores of a state into a world whose scenes have been brought to their steps.

    Raises:
        ValueError: An entry is missing, or does not fit.
    """
    put(world, ("seeds", "steps", *names), state)
    if hasattr(world, "scorer"):
        world.scorer.set_state(part(state, "scorer"), world.steps)


def draw_again(world: Any, names: tuple[str, ...], state: Mapping[str, NDArray[Any]], longest: int) -> None:
    """Start the scenes of a state's seeds, and write its steps and scores; what is observed there follows from them.

    Raises:
        ValueError: An entry is missing, or does not fit.
    """
    seeds, _ = checked_rows(world, state, longest)
    world.reset(range(world.count), seeds.tolist())
    put_scores(world, names, state)
