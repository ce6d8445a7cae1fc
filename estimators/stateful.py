"""`Stateful` wraps a stateless estimator and keeps its state, for use in a plain loop; functions on nested states."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from servotrack.estimators.types import Estimator, Mask

State = TypeVar("State")
Measurement = TypeVar("Measurement")
Estimate = TypeVar("Estimate")


def select_rows(mask: Mask, chosen: State, otherwise: State) -> State:
    """Select rows of `chosen` where `mask` is true, and rows of `otherwise` elsewhere.

    Args:
        mask: Mask of the rows taken from `chosen`. Shape (*batch,), bool.
        chosen: Array with leading axes `batch`, or nested tuples and NamedTuples of such arrays; None stays.
        otherwise: Values with the structure of `chosen`. Where one of two arrays is larger behind the batch axes, as in
            the state of a filter whose arrays have grown, the other one is filled up with zeros.

    Returns:
        New arrays in the structure of `chosen`.
    """
    if isinstance(chosen, tuple):
        parts = [select_rows(mask, a, b) for a, b in zip(chosen, otherwise, strict=True)]  # type: ignore[call-overload]
        return type(chosen)(*parts) if hasattr(chosen, "_fields") else type(chosen)(parts)  # type: ignore[return-value]
    if chosen is None:
        return otherwise
    a, b = np.asarray(chosen), np.asarray(otherwise)
    if a.shape != b.shape:
        shape = np.maximum(a.shape, b.shape)
        a, b = (np.pad(x, [(0, int(more)) for more in shape - x.shape]) for x in (a, b))
    return np.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)  # type: ignore[return-value]


def add_axis(tree: State) -> State:
    """Return the nested NamedTuples with a leading batch axis of length 1 in every array; None stays."""
    if isinstance(tree, tuple):
        # Leaves are told apart here: a call for each of them takes as long as the step of a filter of few targets.
        leaves = [
            leaf[None]
            if type(leaf) is np.ndarray and leaf.flags.c_contiguous
            else (None if leaf is None else add_axis(leaf))
            for leaf in tree
        ]
        return tree._make(leaves)  # type: ignore[attr-defined, no-any-return]
    return np.ascontiguousarray(np.asarray(tree)[None])  # type: ignore[return-value]


def first_row(tree: State) -> State:
    """Return the first row of every array in nested NamedTuples, without the batch axis."""
    if isinstance(tree, tuple):
        leaves = [leaf[0, ...] if type(leaf) is np.ndarray else first_row(leaf) for leaf in tree]
        return tree._make(leaves)  # type: ignore[attr-defined, no-any-return]
    return np.asarray(tree)[0, ...]  # type: ignore[return-value]


def copied(tree: State) -> State:
    """Return a deep copy of nested NamedTuples of arrays."""
    if isinstance(tree, tuple):
        return type(tree)(*[copied(leaf) for leaf in tree])
    return np.array(tree)  # type: ignore[return-value]


class Stateful(Generic[Measurement, State, Estimate]):
    """Estimator together with its state: `Stateful(estimator).step(measurement) -> estimate`.

    Args:
        estimator: Estimator with `initial(measurement)` and `step(state, measurement)`.

    Attributes:
        estimator: The wrapped estimator.
        state: State after the latest measurement; None before the first one and after `reset`.
    """

    def __init__(self, estimator: Estimator[Measurement, State, Estimate]) -> None:
        self.estimator = estimator
        self.state: State | None = None

    def step(self, measurement: Measurement) -> Estimate:
        """Update the state with one measurement and return the estimate.

        The first call, and the first one after `reset`, also makes the initial state.
        """
        state = self.estimator.initial(measurement) if self.state is None else self.state
        self.state, estimate = self.estimator.step(state, measurement)
        return estimate

    def reset(self) -> None:
        """Drop the state, so that the next `step` starts a new run."""
        self.state = None
