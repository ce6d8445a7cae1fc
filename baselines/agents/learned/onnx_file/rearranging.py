"""Operators that cut, join and reorder tensors, and those that calculate with shapes."""

from __future__ import annotations

from collections.abc import Mapping

from servotrack.baselines.agents.learned.onnx_file.elementwise import Check
from servotrack.baselines.agents.learned.onnx_file.extents import (
    MOST_KNOWN,
    Extent,
    Rows,
    Value,
    add,
    broadcast,
    fixed,
    merged,
    product,
    shown,
    stored,
)
from servotrack.baselines.agents.learned.onnx_file.reader import FLOAT, INT32, INT64
from servotrack.baselines.agents.learned.onnx_file.step import Step, axes_of

_TO_THE_END = 2**31 - 1
"""Ends of slices from here on mean all of the axis."""


def _concat(step: Step) -> list[Value]:
    step.expect(1, 64)
    values = [step.value(k) for k in range(len(step.inputs))]
    first = values[0]
    axis = step.axis("axis", None, len(first.shape))
    total: Extent = 0
    for value in values:
        like_first = (*value.shape[:axis], first.shape[axis], *value.shape[axis + 1 :])
        if value.kind != first.kind or like_first != first.shape:
            raise ValueError(f"inputs must agree in type and in all axes but {axis}")
        total = add(total, value.shape[axis])
    known = None
    if len(first.shape) == 1 and all(value.known is not None for value in values):
        known = tuple(number for value in values for number in value.known or ())
    return [Value(first.kind, (*first.shape[:axis], total, *first.shape[axis + 1 :]), known)]


def _constant(step: Step) -> list[Value]:
    step.expect(0, 0)
    tensor = step.tensor("value")
    if tensor is None:
        raise ValueError("must have the attribute 'value', a tensor")
    return [stored(tensor)]


def _constant_of_shape(step: Step) -> list[Value]:
    step.expect(1, 1)
    shape, tensor = _extents(step, 0), step.tensor("value")
    if tensor is not None and tensor.values.shape != (1,):
        raise ValueError("attribute 'value' must hold one number")
    filling = Value(FLOAT, (1,)) if tensor is None else stored(tensor)
    count, power = product(shape)
    known = filling.known * count if filling.known and power == 0 and count <= MOST_KNOWN else None
    return [Value(filling.kind, shape, known)]


def _extents(step: Step, index: int) -> tuple[Extent, ...]:
    """Return an input that is a shape."""
    shape = step.extents(index)
    if not all(isinstance(extent, Rows) or extent >= 1 for extent in shape):
        raise ValueError(f"extents must be >= 1, got {shown(shape[:9])}")
    return shape


def _expand(step: Step) -> list[Value]:
    step.expect(2, 2)
    value = step.value(0)
    return [Value(value.kind, broadcast(value.shape, _extents(step, 1)))]


def _flatten(step: Step) -> list[Value]:
    step.expect(1, 1)
    value = step.value(0)
    axis = step.integer("axis", 1, 0, len(value.shape))
    return [Value(value.kind, (merged(value.shape[:axis]), merged(value.shape[axis:])))]


def _gather(step: Step) -> list[Value]:
    step.expect(2, 2)
    value, indices = step.value(0), step.value(1, INT64, INT32)
    axis = step.axis("axis", 0, len(value.shape))
    extent = value.shape[axis]
    # A batch has at least one row.
    length = 1 if isinstance(extent, Rows) else extent
    chosen = [i for i in indices.known or () if isinstance(i, int) and -length <= i < length]
    if indices.known is None or len(chosen) != len(indices.known):
        raise ValueError(f"indices must be constants within axis {axis}, at most {MOST_KNOWN}")
    known = None
    if value.known is not None and len(value.shape) == 1:
        known = tuple(value.known[i] for i in chosen)
    return [Value(value.kind, (*value.shape[:axis], *indices.shape, *value.shape[axis + 1 :]), known)]


def _reshape(step: Step) -> list[Value]:
    step.expect(2, 2)
    step.integer("allowzero", 0, 0, 0)
    value, target = step.value(0), list(step.extents(1))
    for axis, extent in enumerate(target):
        if extent == 0:
            if axis >= len(value.shape):
                raise ValueError(f"axis {axis} of the target must not be 0")
            target[axis] = value.shape[axis]
    unknown = [axis for axis, extent in enumerate(target) if extent == -1]
    if len(unknown) > 1 or any(isinstance(extent, int) and extent < -1 for extent in target):
        raise ValueError(f"the target must have extents >= 1 and at most one -1, got {shown(target[:9])}")
    count, power = product(value.shape)
    if unknown:
        rest, grows = product([extent for extent in target if extent != -1])
        if rest == 0 or count % rest or not 0 <= power - grows <= 1:
            raise ValueError(f"shape {shown(value.shape)} does not fit the target {shown(target)}")
        target[unknown[0]] = Rows(count // rest) if power > grows else count // rest
    elif product(target) != (count, power):
        raise ValueError(f"shape {shown(value.shape)} does not fit the target {shown(target)}")
    return [Value(value.kind, tuple(target), value.known)]


def _shape(step: Step) -> list[Value]:
    step.expect(1, 1)
    shape = step.value(0).shape
    start, end = step.integer("start", 0, -8, 8), step.integer("end", len(shape), -8, 8)
    found = shape[start:end]
    return [Value(INT64, (len(found),), found)]


def _slice(step: Step) -> list[Value]:
    step.expect(3, 5)
    value = step.value(0)
    starts, ends = step.numbers(1), step.numbers(2)
    axes = step.numbers(3) if step.optional(3) is not None else list(range(len(starts)))
    steps = step.numbers(4) if step.optional(4) is not None else [1] * len(starts)
    if not len(starts) == len(ends) == len(axes) == len(steps):
        raise ValueError("starts, ends, axes and steps must be of equal length")
    shape, known = list(value.shape), value.known
    for axis, start, end, stride in zip(axes_of(axes, len(shape)), starts, ends, steps, strict=True):
        extent = shape[axis]
        if stride < 1:
            raise ValueError(f"steps must be >= 1, got {stride}")
        if isinstance(extent, Rows):
            if (start, stride) != (0, 1) or end < _TO_THE_END:
                raise ValueError("the axis of the batch must not be cut")
            continue
        chosen = range(extent)[start:end:stride]
        shape[axis] = len(chosen)
        known = tuple(known[i] for i in chosen) if known is not None and len(shape) == 1 else None
    return [Value(value.kind, tuple(shape), known)]


def _split(step: Step) -> list[Value]:
    step.expect(1, 2, outputs=64)
    value = step.value(0)
    axis = step.axis("axis", 0, len(value.shape))
    extent = fixed(value.shape[axis], "the axis that is split")
    if step.optional(1) is not None:
        parts = step.numbers(1)
    else:
        # Before opset 18 there was no such attribute, since then it must be given.
        given = None if step.opset >= 18 else step.outputs
        count = step.integer("num_outputs", given, step.outputs, step.outputs)
        parts = [extent // count] * count
    if len(parts) != step.outputs or sum(parts) != extent or min(parts) < 1:
        raise ValueError(f"axis {axis} of extent {extent} cannot be split into {parts[:9]}")
    return [Value(value.kind, (*value.shape[:axis], part, *value.shape[axis + 1 :])) for part in parts]


def _squeeze(step: Step) -> list[Value]:
    step.expect(2, 2)
    value = step.value(0)
    axes = axes_of(step.numbers(1), len(value.shape))
    if any(value.shape[axis] != 1 for axis in axes):
        raise ValueError(f"axes {axes} of {shown(value.shape)} must be 1")
    shape = tuple(extent for axis, extent in enumerate(value.shape) if axis not in axes)
    return [Value(value.kind, shape, value.known)]


def _unsqueeze(step: Step) -> list[Value]:
    step.expect(2, 2)
    value = step.value(0)
    numbers = step.numbers(1)
    rank = len(value.shape) + len(numbers)
    axes, rest = axes_of(numbers, rank), iter(value.shape)
    shape = tuple(1 if axis in axes else next(rest) for axis in range(rank))
    return [Value(value.kind, shape, value.known)]


def _transpose(step: Step) -> list[Value]:
    step.expect(1, 1)
    value = step.value(0)
    rank = len(value.shape)
    order = step.integers("perm", list(range(rank))[::-1], rank, 0, max(rank - 1, 0))
    if len(set(order)) != rank:
        raise ValueError(f"attribute 'perm' must name every axis once, got {order}")
    return [Value(value.kind, tuple(value.shape[axis] for axis in order), value.known if rank < 2 else None)]


REARRANGING: Mapping[str, Check] = {
    "Concat": _concat,
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Expand": _expand,
    "Flatten": _flatten,
    "Gather": _gather,
    "Reshape": _reshape,
    "Shape": _shape,
    "Slice": _slice,
    "Split": _split,
    "Squeeze": _squeeze,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}
"""Checks of the operators by name."""
