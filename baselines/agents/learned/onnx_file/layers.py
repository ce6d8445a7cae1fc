"""Operators that are layers: products, convolutions, pools, reductions, normalizations and recurrent layers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from servotrack.baselines.agents.learned.onnx_file.elementwise import Check
from servotrack.baselines.agents.learned.onnx_file.extents import (
    Extent,
    Rows,
    Shape,
    Value,
    broadcast,
    fixed,
    product,
    shown,
)
from servotrack.baselines.agents.learned.onnx_file.reader import FLOAT
from servotrack.baselines.agents.learned.onnx_file.step import Step, axes_of

_KERNEL = (1, 1024)
"""Bounds of kernels, strides and dilations."""


def _gemm(step: Step) -> list[Value]:
    step.expect(2, 3)
    step.number("alpha", 1.0)
    step.number("beta", 1.0)
    shapes = []
    for k, name in enumerate(("transA", "transB")):
        shape = step.value(k, FLOAT).shape
        if len(shape) != 2:
            raise ValueError(f"input {k} must be a matrix, got shape {shown(shape)}")
        shapes.append(shape[::-1] if step.integer(name, 0, 0, 1) else shape)
    result, length = _multiplied(*shapes)
    addend = step.optional(2, FLOAT)
    if addend is not None and broadcast(addend.shape, result) != result:
        raise ValueError(f"input 2 of shape {shown(addend.shape)} does not fit the product {shown(result)}")
    step.work.append(product((*result, 2 * length)))
    return [Value(FLOAT, result)]


def _matmul(step: Step) -> list[Value]:
    step.expect(2, 2)
    one, other = (step.value(k, FLOAT).shape for k in (0, 1))
    if min(len(one), len(other)) < 2:
        raise ValueError("factors must have at least two axes")
    matrix, length = _multiplied(one[-2:], other[-2:])
    result = (*broadcast(one[:-2], other[:-2]), *matrix)
    step.work.append(product((*result, 2 * length)))
    return [Value(FLOAT, result)]


def _multiplied(one: Shape, other: Shape) -> tuple[Shape, int]:
    """Return the shape of a product of matrices, and the length of its sums."""
    if one[1] != other[0]:
        raise ValueError(f"matrices of shapes {shown(one)} and {shown(other)} do not fit")
    return (one[0], other[1]), fixed(one[1], "the axis that is summed")


def _image(step: Step) -> tuple[Extent, int, list[int]]:
    """Return batch, number of channels and extents of an image or a sequence."""
    shape = step.value(0, FLOAT).shape
    if len(shape) not in (3, 4):
        raise ValueError(f"input 0 must have shape (batch, channels, *extents) of 3 or 4 axes, got {shown(shape)}")
    channels, *extents = (fixed(extent, "an axis of the image") for extent in shape[1:])
    return shape[0], channels, extents


def _windows(step: Step, extents: Sequence[int], kernel: Sequence[int], narrow: bool = False) -> list[int]:
    """Return the number of positions of a kernel along each axis; `narrow` refuses those that see padding only."""
    axes = len(extents)
    padding = step.text("auto_pad", "NOTSET", "VALID", "SAME_UPPER", "SAME_LOWER")
    strides = step.integers("strides", [1] * axes, axes, *_KERNEL)
    dilations = step.integers("dilations", [1] * axes, axes, *_KERNEL)
    pads = step.integers("pads", [0] * (2 * axes), 2 * axes, 0, _KERNEL[1])
    if padding.startswith("SAME"):
        return [-(-extent // stride) for extent, stride in zip(extents, strides, strict=True)]
    found = []
    for axis, extent in enumerate(extents):
        reach = dilations[axis] * (kernel[axis] - 1) + 1
        if narrow and max(pads[axis], pads[axes + axis]) >= kernel[axis]:
            raise ValueError(f"pads must be below the kernel's extent {kernel[axis]}")
        padded = extent + pads[axis] + pads[axes + axis]
        if reach > padded:
            raise ValueError(f"a kernel of reach {reach} does not fit an axis of {extent} padded to {padded}")
        found.append((padded - reach) // strides[axis] + 1)
    return found


def _conv(step: Step) -> list[Value]:
    step.expect(2, 3)
    batch, channels, extents = _image(step)
    weights = step.value(1, FLOAT).shape
    if len(weights) != 2 + len(extents):
        raise ValueError(f"weights must have {2 + len(extents)} axes, got {len(weights)}")
    filters, depth, *kernel = (fixed(extent, "an axis of the weights") for extent in weights)
    groups = step.integer("group", 1, 1, 2**16)
    if channels != depth * groups or filters % groups:
        raise ValueError(f"{channels} channels do not fit {filters} filters of {depth} channels in {groups} groups")
    bias = step.optional(2, FLOAT)
    if bias is not None and bias.shape != (filters,):
        raise ValueError(f"the bias must have shape ({filters},), got {shown(bias.shape)}")
    if step.integers("kernel_shape", kernel, len(kernel), *_KERNEL) != kernel:
        raise ValueError(f"attribute 'kernel_shape' must be that of the weights, {kernel}")
    result = (batch, filters, *_windows(step, extents, kernel))
    taps = depth * math.prod(kernel)
    step.work.append(product((*result, 2 * taps)))
    step.scratch = 4 * taps * math.prod(fixed(extent, "an axis of the image") for extent in result[2:])
    return [Value(FLOAT, result)]


def _pool(step: Step) -> list[Value]:
    step.expect(1, 1)
    batch, channels, extents = _image(step)
    kernel = step.integers("kernel_shape", None, len(extents), *_KERNEL)
    step.integer("ceil_mode", 0, 0, 0)
    result = (batch, channels, *_windows(step, extents, kernel, narrow=True))
    step.work.append(product((*result, math.prod(kernel))))
    return [Value(FLOAT, result)]


def _average_pool(step: Step) -> list[Value]:
    step.integer("count_include_pad", 0, 0, 1)
    return _pool(step)


def _max_pool(step: Step) -> list[Value]:
    step.integer("storage_order", 0, 0, 0)
    return _pool(step)


def _global_average_pool(step: Step) -> list[Value]:
    step.expect(1, 1)
    batch, channels, extents = _image(step)
    step.work.append(product((batch, channels, *extents)))
    return [Value(FLOAT, (batch, channels, *[1] * len(extents)))]


def _batch_normalization(step: Step) -> list[Value]:
    step.expect(5, 5)
    step.number("epsilon", 1e-5)
    step.number("momentum", 0.9)
    step.integer("training_mode", 0, 0, 0)
    shape = step.value(0, FLOAT).shape
    if not 2 <= len(shape) <= 4 or any(step.value(k, FLOAT).shape != shape[1:2] for k in range(1, 5)):
        raise ValueError(f"parameters must have one number per channel of {shown(shape)}")
    fixed(shape[1], "the axis of the channels")
    return [Value(FLOAT, shape)]


def _layer_normalization(step: Step) -> list[Value]:
    step.expect(2, 3)
    step.number("epsilon", 1e-5)
    step.integer("stash_type", 1, 1, 1)
    shape = step.value(0, FLOAT).shape
    normalized = shape[step.axis("axis", -1, len(shape)) :]
    for k in range(1, len(step.inputs)):
        if step.value(k, FLOAT).shape != normalized or product(normalized).power:
            raise ValueError(f"parameters must have the shape of the normalized axes, {shown(normalized)}")
    step.work.append(product((*shape, 5)))
    return [Value(FLOAT, shape)]


def _softmax(step: Step) -> list[Value]:
    step.expect(1, 1)
    shape = step.value(0, FLOAT).shape
    fixed(shape[step.axis("axis", -1, len(shape))], "the axis of a softmax")
    return [Value(FLOAT, shape)]


def _reduction(first_input: int) -> Check:
    """Return a reduction; from an opset on, its axes are an input, before an attribute."""

    def check(step: Step) -> list[Value]:
        shape, kept = step.value(0, FLOAT).shape, step.integer("keepdims", 1, 0, 1)
        numbers: list[int] | None = None
        if step.opset >= first_input:
            step.expect(1, 2)
            step.integer("noop_with_empty_axes", 0, 0, 0)
            numbers = step.numbers(1) if step.optional(1) is not None else None
        else:
            step.expect(1, 1)
            numbers = step.integers("axes", None, None, -8, 8) if step.has("axes") else None
        if numbers == []:
            raise ValueError("axes must not be empty")
        axes = axes_of(range(len(shape)) if numbers is None else numbers, len(shape))
        step.work.append(product(shape))
        result = [1 if axis in axes else extent for axis, extent in enumerate(shape) if kept or axis not in axes]
        return [Value(FLOAT, tuple(result))]

    return check


def _recurrent(gates: int) -> Check:
    """Return a recurrent layer that runs forward: 3 gates for GRU, 4 for LSTM."""

    def check(step: Step) -> list[Value]:
        states = 2 if gates == 4 else 1
        step.expect(3, 5 + states, outputs=1 + states)
        step.text("direction", "forward")
        step.integer("layout", 0, 0, 0)
        if gates == 3:
            step.integer("linear_before_reset", 0, 0, 1)
        else:
            step.integer("input_forget", 0, 0, 0)
        hidden = step.integer("hidden_size", None, 1, 2**14)
        shape = step.value(0, FLOAT).shape
        if len(shape) != 3:
            raise ValueError(f"input 0 must have shape (steps, batch, size), got {shown(shape)}")
        length, batch, size = shape
        wide = gates * hidden
        wanted: list[tuple[int, Shape]] = [(1, (1, wide, size)), (2, (1, wide, hidden)), (3, (1, 2 * wide))]
        wanted += [(5 + k, (1, batch, hidden)) for k in range(states)]
        for k, needed in wanted:
            given = step.value(k, FLOAT) if k < 3 else step.optional(k, FLOAT)
            if given is not None and given.shape != needed:
                raise ValueError(f"input {k} must have shape {shown(needed)}, got {shown(given.shape)}")
        if step.optional(4) is not None:
            raise ValueError("lengths of sequences are not allowed")
        step.work.append(product((length, batch, 2 * wide * (fixed(size, "the size of a step") + hidden))))
        if isinstance(length, Rows) and isinstance(batch, Rows):
            raise ValueError("a tensor must not grow with the square of the number of rows")
        return [Value(FLOAT, (length, 1, batch, hidden)), *[Value(FLOAT, (1, batch, hidden))] * states]

    return check


LAYERS: Mapping[str, Check] = {
    "AveragePool": _average_pool,
    "BatchNormalization": _batch_normalization,
    "Conv": _conv,
    "GRU": _recurrent(3),
    "Gemm": _gemm,
    "GlobalAveragePool": _global_average_pool,
    "LSTM": _recurrent(4),
    "LayerNormalization": _layer_normalization,
    "MatMul": _matmul,
    "MaxPool": _max_pool,
    "ReduceMax": _reduction(18),
    "ReduceMean": _reduction(18),
    "ReduceMin": _reduction(18),
    "ReduceSum": _reduction(13),
    "Softmax": _softmax,
}
"""Checks of the operators by name."""
