"""Estimators are values and functions; this holds their state for people who want a loop."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from servotrack.estimators.types import Mask

State = TypeVar("State")


def select_rows(mask: Mask, chosen: State, otherwise: State) -> State:
    """Rows of `chosen` where `mask` is true, else of `otherwise`.

    Args:
        mask: Shape (*batch,), bool.
        chosen: An array with leading axes `batch`, or nested tuples and NamedTuples of such arrays.
        otherwise: The same structure.

    Returns:
        The same structure, new arrays.
    """
    if isinstance(chosen, tuple):
        parts = [select_rows(mask, a, b) for a, b in zip(chosen, otherwise, strict=True)]  # type: ignore[call-overload]
        return type(chosen)(*parts) if hasattr(chosen, "_fields") else type(chosen)(parts)  # type: ignore[return-value]
    a, b = np.asarray(chosen), np.asarray(otherwise)
    return np.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)  # type: ignore[return-value]


def add_axis(tree: State) -> State:
    """The same nested NamedTuples with a leading axis of one run."""
    if isinstance(tree, tuple):
        return type(tree)(*[add_axis(leaf) for leaf in tree])
    return np.ascontiguousarray(np.asarray(tree)[None])  # type: ignore[return-value]


def first_row(tree: State) -> State:
    """The same nested NamedTuples of the first run, without the axis."""
    if isinstance(tree, tuple):
        return type(tree)(*[first_row(leaf) for leaf in tree])
    return np.asarray(tree[0])  # type: ignore[index,return-value]


def copied(tree: State) -> State:
    """The same nested NamedTuples with arrays of their own."""
    if isinstance(tree, tuple):
        return type(tree)(*[copied(leaf) for leaf in tree])
    return np.array(tree)  # type: ignore[return-value]


class Stateful:
    """An estimator with its state: `Stateful(estimator).step(measurement) -> estimate`.

    Args:
        estimator: Anything with `initial(measurement)` and `step(state, measurement)`.
    """

    def __init__(self, estimator: Any) -> None:
        self.estimator = estimator
        self.state: Any = None

    def step(self, measurement: Any) -> Any:
        """Fold one measurement in and return the estimate; the first call also makes the initial state."""
        if self.state is None:
            self.state = self.estimator.initial(measurement)
        self.state, estimate = self.estimator.step(self.state, measurement)
        return estimate

    def reset(self) -> None:
        """Forget everything."""
        self.state = None
