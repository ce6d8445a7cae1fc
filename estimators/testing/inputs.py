"""Inputs of a family of estimators: the part of `check_estimator` that knows what measurements look like."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from servotrack.estimators.testing.values import Path, numbers_in, replaced
from servotrack.estimators.types import Mask

Arguments: TypeAlias = Mapping[str, Any]
"""Arguments of `initial`, or of `step` after the state, by name and in order."""


AnyEstimator: TypeAlias = Any
"""Object under test: an estimator, controller, tracker or detector; what it lacks is found at run time."""


class Sequence(NamedTuple):
    """One run of an estimator.

    Attributes:
        start: Arguments of `initial`.
        steps: Arguments of each `step`, without the state.
    """

    start: Arguments
    steps: tuple[Arguments, ...]


class Bad(NamedTuple):
    """Arguments that an estimator must refuse.

    Attributes:
        fault: Description of what is wrong.
        names: Names of which the error message must have one.
        arguments: The arguments.
    """

    fault: str
    names: tuple[str, ...]
    arguments: Arguments


class Inputs(ABC):
    """Inputs of one family of estimators. Derive from it to check estimators with measurements of another form.

    Attributes:
        replays: True if a state is a value from which a step can be repeated; false for estimators around objects of
            other libraries that change in place.
        open_axes: Names of the arguments that accept further leading axes.
        open_lengths: Names of fields whose last axis may have another length.
        not_rounded: Names of arguments and fields whose values cannot be rounded to whole numbers.
        may_be_infinite: Names of the fields of states that are documented to hold infinities.
    """

    replays: bool = True
    open_axes: ClassVar[frozenset[str]] = frozenset()
    open_lengths: ClassVar[frozenset[str]] = frozenset()
    not_rounded: ClassVar[frozenset[str]] = frozenset()
    may_be_infinite: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def draw(self, rng: np.random.Generator, steps: int, *, extreme: bool = False) -> Sequence:
        """Draw a sequence of valid measurements.

        Args:
            rng: Source of random numbers.
            steps: Number of steps.
            extreme: False for measurements as in practice, which an estimator must accept. True for any finite values
                within the documented limits, which it may also refuse.
        """

    @property
    def rows(self) -> int:
        """Number of independent sequences in one drawn batch."""
        return 1

    def prepare(self) -> None:
        """Set the state of generators of other libraries from which the estimator draws, before every run."""
        return

    def initial(self, estimator: AnyEstimator, arguments: Arguments) -> Any:
        """Return the estimator's initial state."""
        return estimator.initial(*arguments.values())

    def step(self, estimator: AnyEstimator, state: Any, arguments: Arguments) -> tuple[Any, Any]:
        """Return the new state and the estimate."""
        state, estimate = estimator.step(state, *arguments.values())
        return state, estimate

    def results(self, estimate: Any) -> Any:
        """Return the values of an estimate that must be finite, such as the estimate and what its methods compute."""
        return estimate

    def unread(self, arguments: Arguments) -> Mapping[Path, Mask]:
        """Masks of entries that count as unseen by their paths: they may hold NaN and must have no effect."""
        return {}

    def malformed(self, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
        """Yield further arguments that must be refused, besides those of `bad_arguments`.

        Args:
            rng: Source of random numbers.
            arguments: Valid arguments.
            first: True if they are those of `initial`.
        """
        yield from ()


def bad_arguments(inputs: Inputs, rng: np.random.Generator, arguments: Arguments, first: bool) -> Iterator[Bad]:
    """Yield arguments of which one is not finite or not an array of numbers of the right form.

    Args:
        inputs: Inputs of the family.
        rng: Source of the places of bad values.
        arguments: Valid arguments.
        first: True if they are those of `initial`.
    """
    unread = inputs.unread(arguments)
    for path, array in numbers_in(arguments):
        names = tuple(key for key in path if not key.isdigit())[-2:]

        def changed(fault: str, value: Any, path: Path = path, names: tuple[str, ...] = names) -> Bad:
            return Bad(f"{'.'.join(path)} {fault}", names, replaced(arguments, path, value))

        if array.dtype.kind == "f" and array.size:
            used = ~np.broadcast_to(unread.get(path, False), array.shape)
            places = np.argwhere(used)
            for value in (np.nan, np.inf, -np.inf) if len(places) else ():
                place = tuple(places[rng.integers(len(places))])
                broken = array.copy()
                broken[place] = value
                yield changed(f"with {value} at index {[int(i) for i in place]}", broken)
        if array.size:
            yield changed("as text", array.astype(str))
            yield changed("as complex numbers", array.astype(np.complex128))
            yield changed("as objects", np.full(array.shape, None))
        yield changed("as a ragged list", [[1.0], [1.0, 2.0]])
        if array.ndim:
            yield changed("as a scalar", array.dtype.type(0))
            if array.shape[-1] and path[-1] not in inputs.open_lengths:
                yield changed("without its last axis' entries", array[..., :0])
        if path[0] not in inputs.open_axes:
            yield changed("with an axis too many", array[None])
    yield from inputs.malformed(rng, arguments, first)


def magnitude(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a magnitude whose logarithm is uniform between those of two positive numbers."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
