"""One node of a network while it is checked."""

from __future__ import annotations

import math
from collections.abc import Sequence

from servotrack.baselines.agents.learned.onnx_file.extents import MOST_KNOWN, Extent, Rows, Size, Value
from servotrack.baselines.agents.learned.onnx_file.reader import INT32, INT64, TYPES, Node, Tensor


class Step:
    """Inputs and attributes of a node; everything that its operator does not read is refused by `close`.

    Args:
        node: The node.
        inputs: Inputs, None for an omitted one.
        opset: Version of the operators.
    """

    def __init__(self, node: Node, inputs: Sequence[Value | None], opset: int) -> None:
        self.inputs, self.opset, self.outputs = inputs, opset, len(node.outputs)
        self._attributes = dict(node.attributes)
        self.work: list[Size] = []
        """Operations beyond one for each element of the outputs."""
        self.scratch = 0
        """Memory that the operator needs while it works, bytes."""

    def close(self) -> None:
        """Raise ValueError for attributes that the operator did not read."""
        if self._attributes:
            raise ValueError(f"attribute {next(iter(self._attributes))!r} is not allowed")

    def expect(self, least: int, most: int, outputs: int = 1) -> None:
        """Check the number of inputs and outputs.

        Raises:
            ValueError: Too few or too many.
        """
        if not least <= len(self.inputs) <= most:
            raise ValueError(f"must have {least} to {most} inputs, got {len(self.inputs)}")
        if not 1 <= self.outputs <= outputs:
            raise ValueError(f"must have 1 to {outputs} outputs, got {self.outputs}")

    def value(self, index: int, *kinds: int) -> Value:
        """Return an input of one of the types; of any type if none are given."""
        found = self.optional(index, *kinds)
        if found is None:
            raise ValueError(f"input {index} is missing")
        return found

    def optional(self, index: int, *kinds: int) -> Value | None:
        """Return an input of one of the types, None if it is omitted."""
        found = self.inputs[index] if index < len(self.inputs) else None
        if found is not None and kinds and found.kind not in kinds:
            wanted = " or ".join(TYPES[kind].name for kind in kinds)
            raise ValueError(f"input {index} must be {wanted}, got {TYPES[found.kind].name}")
        return found

    def extents(self, index: int) -> tuple[Extent, ...]:
        """Return an input of whole numbers that follow from the file and from shapes."""
        value = self.value(index, INT64, INT32)
        if value.known is None or len(value.shape) > 1:
            raise ValueError(f"input {index} must be a constant list of at most {MOST_KNOWN} whole numbers")
        return value.known

    def numbers(self, index: int) -> list[int]:
        """Return an input of whole numbers that do not depend on the number of rows."""
        known = self.extents(index)
        if any(isinstance(number, Rows) for number in known):
            raise ValueError(f"input {index} must not depend on the number of rows")
        return [number for number in known if isinstance(number, int)]

    def axis(self, name: str, default: int | None, rank: int) -> int:
        """Return an attribute that names an axis, as a number >= 0."""
        return axis_of(self.integer(name, default, -8, 8), rank)

    def integer(self, name: str, default: int | None, low: int, high: int) -> int:
        """Return a whole number of the attributes; one without a default must be given."""
        value = self._attributes.pop(name, default)
        if not isinstance(value, int) or not low <= value <= high:
            raise ValueError(f"attribute {name!r} must be a whole number in {low} to {high}, got {value!r}")
        return value

    def integers(self, name: str, default: list[int] | None, count: int | None, low: int, high: int) -> list[int]:
        """Return a list of whole numbers of the attributes, of any length for `count` None."""
        value = self._attributes.pop(name, default)
        if (
            not isinstance(value, list)
            or count not in (None, len(value))
            or not all(isinstance(number, int) and low <= number <= high for number in value)
        ):
            wanted = "a list of" if count is None else count
            raise ValueError(f"attribute {name!r} must be {wanted} whole numbers in {low} to {high}, got {value!r:.60}")
        return value

    def number(self, name: str, default: float) -> float:
        """Return a finite number of the attributes."""
        value = self._attributes.pop(name, default)
        if not isinstance(value, float) or not math.isfinite(value):
            raise ValueError(f"attribute {name!r} must be a finite number, got {value!r}")
        return value

    def text(self, name: str, *choices: str) -> str:
        """Return a text of the attributes; the first choice is the default."""
        value = self._attributes.pop(name, memoryview(choices[0].encode()))
        known = {choice.encode(): choice for choice in choices}
        if not isinstance(value, memoryview) or bytes(value) not in known:
            raise ValueError(f"attribute {name!r} must be {' or '.join(choices)}")
        return known[bytes(value)]

    def tensor(self, name: str) -> Tensor | None:
        """Return a tensor of the attributes, None if it is not given."""
        value = self._attributes.pop(name, None)
        if value is not None and not isinstance(value, Tensor):
            raise ValueError(f"attribute {name!r} must be a tensor")
        return value

    def has(self, name: str) -> bool:
        """Return True for an attribute that is given."""
        return name in self._attributes


def axis_of(axis: int, rank: int) -> int:
    """Return an axis, which may count from the end, as a number >= 0.

    Raises:
        ValueError: There is no such axis.
    """
    if not -rank <= axis < rank:
        raise ValueError(f"axis {axis} is not one of {rank}")
    return axis % rank


def axes_of(axes: Sequence[int], rank: int) -> list[int]:
    """Return several axes as numbers >= 0.

    Raises:
        ValueError: One does not exist, or appears twice.
    """
    found = [axis_of(axis, rank) for axis in axes]
    if len(set(found)) != len(found):
        raise ValueError(f"axes must differ, got {list(axes)[:9]}")
    return found
