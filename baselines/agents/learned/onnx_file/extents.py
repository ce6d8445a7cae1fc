"""Shapes whose extents are whole numbers, or multiples of the number of rows of a batch that is not known yet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from servotrack.baselines.agents.learned.onnx_file.reader import INT32, INT64, Tensor

MOST_KNOWN = 64
"""Largest number of whole numbers of one tensor that are followed through a network."""
LARGEST_NUMBER = 2**40
"""Bound of whole numbers in calculations with shapes."""


class Rows(NamedTuple):
    """An extent that grows with the batch.

    Attributes:
        times: Extent for a batch of one row.
    """

    times: int


Extent = int | Rows
Shape = tuple[Extent, ...]


class Size(NamedTuple):
    """Number of elements or operations.

    Attributes:
        number: Number for a batch of one row.
        power: Power of the number of rows that it grows with.
    """

    number: int
    power: int


class Value(NamedTuple):
    """Everything that is known about a tensor before the network runs.

    Attributes:
        kind: Type, a key of `TYPES`.
        shape: Extents.
        known: Elements in C order, where they follow from the file and from shapes; whole numbers only.
    """

    kind: int
    shape: Shape
    known: tuple[Extent, ...] | None = None


def product(shape: Sequence[Extent]) -> Size:
    """Return the number of elements of a shape."""
    count = math.prod(extent.times if isinstance(extent, Rows) else extent for extent in shape)
    return Size(count, sum(isinstance(extent, Rows) for extent in shape))


def stored(tensor: Tensor) -> Value:
    """Return a tensor of the file as a value."""
    whole = tensor.kind in (INT32, INT64) and tensor.values.size <= MOST_KNOWN
    known = tuple(int(number) for number in tensor.values.ravel()) if whole else None
    return Value(tensor.kind, tuple(tensor.values.shape), known)


def broadcast(*shapes: Shape) -> Shape:
    """Return the shape that operands of different shapes are stretched to; the batch is never stretched.

    Raises:
        ValueError: Extents that differ and are not 1.
    """
    rank = max(map(len, shapes))
    result: list[Extent] = []
    for extents in zip(*((1,) * (rank - len(shape)) + shape for shape in shapes), strict=True):
        others = {extent for extent in extents if extent != 1}
        if len(others) > 1:
            raise ValueError(f"shapes {', '.join(map(shown, shapes))} do not fit")
        result.append(others.pop() if others else 1)
    return tuple(result)


def merged(shape: Shape) -> Extent:
    """Return the extent of several axes as one.

    Raises:
        ValueError: More than one of them grows with the batch.
    """
    count, power = product(shape)
    if power > 1:
        raise ValueError("a tensor must not grow with the square of the number of rows")
    return Rows(count) if power else count


def fixed(extent: Extent, what: str) -> int:
    """Return an extent that must not grow with the batch.

    Raises:
        ValueError: It does.
    """
    if isinstance(extent, Rows):
        raise ValueError(f"{what} must not be the axis of the batch")
    return extent


def shown(shape: Sequence[Extent]) -> str:
    """Return a shape for messages."""
    parts = ["n" if e == Rows(1) else f"{e.times} n" if isinstance(e, Rows) else str(e) for e in shape]
    return f"({', '.join(parts)})"


def stretched(value: Value, shape: Shape) -> tuple[Extent, ...]:
    """Return known elements in a shape that their own is stretched to, of at most one axis longer than 1.

    Raises:
        ValueError: Too many elements, or axes in between.
    """
    count = product(shape).number
    known = value.known or ()
    if len(known) == count:
        return known
    if len(known) == 1 and count <= MOST_KNOWN:
        return known * count
    raise ValueError(f"whole numbers must form lists of equal length, of at most {MOST_KNOWN}")


def bounded(number: Extent) -> Extent:
    """Return a whole number after checking its size."""
    if abs(number.times if isinstance(number, Rows) else number) > LARGEST_NUMBER:
        raise ValueError(f"whole numbers must stay below {LARGEST_NUMBER}")
    return number


def add(a: Extent, b: Extent) -> Extent:
    """Return a + b."""
    if isinstance(a, Rows) and isinstance(b, Rows):
        return bounded(Rows(a.times + b.times))
    if isinstance(a, Rows) or isinstance(b, Rows):
        if a == 0 or b == 0:
            return b if a == 0 else a
        raise ValueError("the number of rows plus a number cannot be an extent")
    return bounded(a + b)


def subtract(a: Extent, b: Extent) -> Extent:
    """Return a - b."""
    if isinstance(a, Rows) or isinstance(b, Rows):
        if b == 0:
            return a
        raise ValueError("the number of rows minus a number cannot be an extent")
    return bounded(a - b)


def multiply(a: Extent, b: Extent) -> Extent:
    """Return a * b."""
    if isinstance(a, Rows) and isinstance(b, Rows):
        raise ValueError("a tensor must not grow with the square of the number of rows")
    if isinstance(a, Rows):
        return bounded(Rows(a.times * _positive(b)))
    if isinstance(b, Rows):
        return bounded(Rows(b.times * _positive(a)))
    return bounded(a * b)


def divide(a: Extent, b: Extent) -> Extent:
    """Return a // b for a >= 0 and b > 0."""
    if isinstance(a, Rows):
        divisor = b.times if isinstance(b, Rows) else _positive(b)
        if a.times % divisor:
            raise ValueError("an extent must be a multiple of the number of rows")
        return a.times // divisor if isinstance(b, Rows) else Rows(a.times // divisor)
    return _not_negative(a) // _positive(b)


def remainder(a: Extent, b: Extent) -> Extent:
    """Return a % b for a >= 0 and b > 0."""
    return _not_negative(a) % _positive(b)


def _positive(number: Extent) -> int:
    if isinstance(number, Rows) or number < 1:
        raise ValueError(f"a factor or divisor must be a number >= 1, got {shown((number,))}")
    return number


def _not_negative(number: Extent) -> int:
    if isinstance(number, Rows) or number < 0:
        raise ValueError(f"a number to divide must be >= 0, got {shown((number,))}")
    return number
