"""Check of a network before it runs: operators, shapes, and bounds of computation and memory."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from servotrack.baselines.agents.learned.onnx_file.elementwise import ELEMENTWISE, Check
from servotrack.baselines.agents.learned.onnx_file.extents import Extent, Rows, Size, Value, product, shown, stored
from servotrack.baselines.agents.learned.onnx_file.layers import LAYERS
from servotrack.baselines.agents.learned.onnx_file.reader import (
    LARGEST_AXIS,
    MOST_AXES,
    TYPES,
    Network,
    Node,
    Port,
    read_network,
)
from servotrack.baselines.agents.learned.onnx_file.rearranging import REARRANGING
from servotrack.baselines.agents.learned.onnx_file.step import Step

OPERATORS: Mapping[str, Check] = {**ELEMENTWISE, **REARRANGING, **LAYERS}
"""Checks of all allowed operators by name."""
MOST_WORK = 500_000_000
"""Largest number of operations for a row of the batch, and of those that do not depend on the batch."""
MOST_ROW_MEMORY = 16_000_000
"""Largest memory of intermediate tensors at one time for a row of the batch, bytes."""
MOST_FIXED_MEMORY = 64_000_000
"""Largest memory of all intermediate tensors that do not depend on the batch, bytes."""
_SLOW = 20
"""Operations for an element of a transcendental function."""
_SLOW_OPERATORS = frozenset(
    {"Elu", "Erf", "Exp", "GRU", "Gelu", "LSTM", "Log", "Pow", "Selu", "Sigmoid", "Softmax", "Softplus", "Tanh"}
)


class Row(NamedTuple):
    """One row of an input or output.

    Attributes:
        kind: Type, a key of `servotrack.baselines.agents.learned.onnx_file.reader.TYPES`.
        shape: Shape, without the axis of the batch.
    """

    kind: int
    shape: tuple[int, ...]


@dataclass(frozen=True)
class CheckedNetwork:
    """A network that may run.

    Attributes:
        inputs: Rows of the inputs by name, in the order of the file.
        outputs: Rows of the outputs by name, in the order of the file.
        row_work: Operations for a row of the batch.
        row_memory: Largest memory of intermediate tensors at one time for a row of the batch, bytes.
        fixed_memory: Memory of all intermediate tensors that do not depend on the batch, bytes.
    """

    inputs: Mapping[str, Row]
    outputs: Mapping[str, Row]
    row_work: int
    row_memory: int
    fixed_memory: int


def check_network(content: bytes) -> CheckedNetwork:
    """Check an ONNX file of unknown origin.

    Args:
        content: The file.

    Returns:
        Inputs, outputs and cost. All extents are known but for the number of rows; work and memory grow at most in
        proportion to it.

    Raises:
        ValueError: A file that is not ONNX, holds something that is not allowed, or costs too much; the message names
            the field or operator.
    """
    network = read_network(content)
    batch = _name_of_batch(network)
    values = {name: stored(tensor) for name, tensor in network.weights.items()}
    inputs = {port.name: _row(port) for port in network.inputs}
    for port in network.inputs:
        _define(values, port.name, Value(port.kind, (Rows(1), *inputs[port.name].shape)))
    cost = _Cost(network, values)
    computed: set[str] = set()
    for index, node in enumerate(network.nodes):
        try:
            step, results = _checked(node, values, network.opset)
            for name, value in zip(node.outputs, results, strict=False):
                if name:
                    _define(values, name, value)
                    computed.add(name)
            cost.add(index, node, step, results)
        except ValueError as error:
            raise ValueError(f"node {index} ({node.operator}): {error}") from error
    if missing := [port.name for port in network.outputs if port.name not in computed]:
        raise ValueError(f"output {missing[0]!r} must be computed by a node")
    names: dict[str, Extent] = {batch: Rows(1)}
    for port in (*network.declared, *network.outputs):
        _compare(port, values, names)
    outputs = {port.name: _rest(port.name, values[port.name]) for port in network.outputs}
    return CheckedNetwork(inputs, outputs, cost.row_work, cost.row_memory, cost.fixed_memory)


def _name_of_batch(network: Network) -> str:
    """Return the name that all inputs and outputs give to their first axis."""
    ports = (*network.inputs, *network.outputs)
    if not network.inputs or not network.outputs or len({port.name for port in ports}) != len(ports):
        raise ValueError("inputs and outputs must exist and have names of their own")
    first = [port.shape[0] if port.shape else None for port in ports]
    name = first[0]
    if not isinstance(name, str) or not name or set(first) != {name}:
        raise ValueError(f"the first axis of all inputs and outputs must have one name, that of the batch, got {first}")
    return name


def _row(port: Port) -> Row:
    extents = [extent for extent in (port.shape or ())[1:] if isinstance(extent, int) and extent >= 1]
    if len(extents) != len(port.shape or ()) - 1:
        raise ValueError(f"{port.name!r} must have known extents behind the batch, got {port.shape}")
    return Row(port.kind, tuple(extents))


def _define(values: dict[str, Value], name: str, value: Value) -> None:
    if name in values:
        raise ValueError(f"{name!r} is defined twice")
    extents = [extent.times if isinstance(extent, Rows) else extent for extent in value.shape]
    # Only lists of extents, of which a part may be cut, are empty.
    least = 1 if value.known is None else 0
    if len(extents) > MOST_AXES or not all(least <= extent <= LARGEST_AXIS for extent in extents):
        raise ValueError(
            f"{name!r} must have at most {MOST_AXES} axes of {least} to {LARGEST_AXIS}, got {shown(value.shape[:9])}"
        )
    if product(value.shape).power > 1:
        raise ValueError(f"{name!r} of shape {shown(value.shape)} grows with the square of the number of rows")
    values[name] = value


def _checked(node: Node, values: Mapping[str, Value], opset: int) -> tuple[Step, list[Value]]:
    """Return a node's outputs after checking it."""
    check = OPERATORS.get(node.operator)
    if check is None:
        near = difflib.get_close_matches(node.operator, OPERATORS, n=1)
        raise ValueError(f"the operator is not allowed{f'; nearest allowed is {near[0]}' if near else ''}")
    for name in node.inputs:
        if name and name not in values:
            raise ValueError(f"input {name!r} is not computed before it is used")
    step = Step(node, [values[name] if name else None for name in node.inputs], opset)
    outputs = check(step)
    step.close()
    return step, outputs


def _rest(name: str, value: Value) -> Row:
    """Return a row of an output."""
    extents = [extent for extent in value.shape[1:] if not isinstance(extent, Rows)]
    if value.shape[0] != Rows(1) or len(extents) != len(value.shape) - 1:
        raise ValueError(f"output {name!r} must have the batch as its first axis, got {shown(value.shape)}")
    return Row(value.kind, tuple(extents))


def _compare(port: Port, values: Mapping[str, Value], names: dict[str, Extent]) -> None:
    """Compare what a file declares with what follows from it; onnxruntime plans memory by declarations.

    Args:
        port: The declaration.
        values: All tensors by name.
        names: Extents by the names that the file gives them; new ones are added.
    """
    value = values.get(port.name)
    if value is None:
        raise ValueError(f"{port.name!r} is declared but not computed")
    fits = port.kind == value.kind and (port.shape is None or len(port.shape) == len(value.shape))
    for declared, extent in zip(port.shape or (), value.shape, strict=False):
        # An axis without number and name has any extent.
        fits = fits and (declared == "" or _meant(declared, extent, names) == extent)
    if not fits:
        shape = "" if port.shape is None else f" ({', '.join(map(str, port.shape))})"
        raise ValueError(
            f"{port.name!r} is declared as {TYPES[port.kind].name}{shape}, but is {TYPES[value.kind].name} "
            f"{shown(value.shape)}"
        )


def _meant(declared: int | str, extent: Extent, names: dict[str, Extent]) -> Extent:
    """Return the extent that a declaration stands for; a new name stands for the given one."""
    return names.setdefault(declared, extent) if isinstance(declared, str) else declared


class _Cost:
    """Sums of work and memory while nodes are added in the order of the file.

    Args:
        network: The network.
        values: Weights and inputs.
    """

    def __init__(self, network: Network, values: Mapping[str, Value]) -> None:
        self.row_work = self.fixed_work = self.row_memory = self._fixed = self._scratch = 0
        self._last_use = {name: index for index, node in enumerate(network.nodes) for name in node.inputs if name}
        self._last_use |= {port.name: len(network.nodes) for port in network.outputs}
        self._live = {port.name: _memory(values[port.name]).number for port in network.inputs}

    @property
    def fixed_memory(self) -> int:
        """Memory of everything that does not depend on the batch, bytes."""
        return self._fixed + self._scratch

    def add(self, index: int, node: Node, step: Step, outputs: list[Value]) -> None:
        """Add a node.

        Raises:
            ValueError: A bound is exceeded.
        """
        slow = _SLOW if node.operator in _SLOW_OPERATORS else 1
        for count, power in (*step.work, *(product((*value.shape, slow)) for value in outputs)):
            if power > 1:
                raise ValueError("work must not grow with the square of the number of rows")
            if power:
                self.row_work += count
            else:
                self.fixed_work += count
        if max(self.row_work, self.fixed_work) > MOST_WORK:
            raise ValueError(f"the network has taken more than {MOST_WORK} operations so far, or for each row")
        self._scratch = max(self._scratch, step.scratch)
        for name, value in zip(node.outputs, outputs, strict=False):
            size = _memory(value)
            if size.power:
                self._live[name] = size.number
            else:
                self._fixed += size.number
        self.row_memory = max(self.row_memory, sum(self._live.values()))
        if self.row_memory > MOST_ROW_MEMORY or self.fixed_memory > MOST_FIXED_MEMORY:
            raise ValueError(
                f"intermediate tensors take {self.row_memory} bytes for each row and {self.fixed_memory} besides, "
                f"at most {MOST_ROW_MEMORY} and {MOST_FIXED_MEMORY} are allowed"
            )
        for name in (*node.inputs, *node.outputs):
            if self._last_use.get(name, index) <= index:
                self._live.pop(name, None)


def _memory(value: Value) -> Size:
    return product((*value.shape, TYPES[value.kind].itemsize))
