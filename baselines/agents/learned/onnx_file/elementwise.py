"""Operators that work on single elements."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from servotrack.baselines.agents.learned.onnx_file.extents import (
    Extent,
    Value,
    add,
    broadcast,
    divide,
    multiply,
    remainder,
    stretched,
    subtract,
)
from servotrack.baselines.agents.learned.onnx_file.reader import BOOL, FLOAT, INT32, INT64, TYPES
from servotrack.baselines.agents.learned.onnx_file.step import Step

Check = Callable[[Step], list[Value]]
"""Check of a node: returns its outputs, raises ValueError for what its operator must not have."""


def _single(step: Step) -> list[Value]:
    step.expect(1, 1)
    value = step.value(0, FLOAT)
    return [Value(FLOAT, value.shape)]


def _with_numbers(*names: str) -> Check:
    """Return an operator of one operand whose attributes are numbers."""

    def check(step: Step) -> list[Value]:
        for name in names:
            step.number(name, 1.0)
        return _single(step)

    return check


def _gelu(step: Step) -> list[Value]:
    step.text("approximate", "none", "tanh")
    return _single(step)


def _identity(step: Step) -> list[Value]:
    step.expect(1, 1)
    return [step.value(0)]


def _extreme(step: Step) -> list[Value]:
    step.expect(1, 16)
    return [Value(FLOAT, broadcast(*(step.value(k, FLOAT).shape for k in range(len(step.inputs)))))]


def _power(step: Step) -> list[Value]:
    step.expect(2, 2)
    return [Value(FLOAT, broadcast(step.value(0, FLOAT).shape, step.value(1, FLOAT).shape))]


def _arithmetic(combine: Callable[[Extent, Extent], Extent], result: int | None = None) -> Check:
    """Return an operator of two operands: floats, or whole numbers that are known.

    Args:
        combine: Result for two whole numbers. They must be known because onnxruntime ends the process when whole
            numbers are divided by zero.
        result: Type of the result; None: that of the operands.
    """

    def check(step: Step) -> list[Value]:
        step.expect(2, 2)
        one, other = step.value(0, FLOAT, INT32, INT64), step.value(1)
        if one.kind != other.kind:
            raise ValueError("operands must be of one type")
        kind, shape = one.kind if result is None else result, broadcast(one.shape, other.shape)
        if one.kind == FLOAT:
            return [Value(kind, shape)]
        if one.known is None or other.known is None:
            raise ValueError("operands must be float32, or whole numbers that follow from the file and from shapes")
        pairs = zip(stretched(one, shape), stretched(other, shape), strict=True)
        return [Value(kind, shape, tuple(combine(a, b) for a, b in pairs))]

    return check


def _remainder(step: Step) -> list[Value]:
    step.integer("fmod", 0, 0, 0)
    step.value(0, INT32, INT64)
    return _arithmetic(remainder)(step)


def _comparison(step: Step) -> list[Value]:
    step.expect(2, 2)
    return [Value(BOOL, broadcast(step.value(0, FLOAT).shape, step.value(1, FLOAT).shape))]


def _logical(operands: int) -> Check:
    """Return an operator of one or two operands that are true or false."""

    def check(step: Step) -> list[Value]:
        step.expect(operands, operands)
        return [Value(BOOL, broadcast(*(step.value(k, BOOL).shape for k in range(operands))))]

    return check


def _where(step: Step) -> list[Value]:
    step.expect(3, 3)
    condition, one, other = step.value(0, BOOL), step.value(1), step.value(2)
    if one.kind != other.kind:
        raise ValueError("both alternatives must be of one type")
    shape = broadcast(condition.shape, one.shape, other.shape)
    if condition.known is None or one.known is None or other.known is None:
        return [Value(one.kind, shape)]
    choices = zip(*(stretched(value, shape) for value in (condition, one, other)), strict=True)
    return [Value(one.kind, shape, tuple(a if true else b for true, a, b in choices))]


def _cast(step: Step) -> list[Value]:
    step.expect(1, 1)
    value, kind = step.value(0), step.integer("to", None, 1, 16)
    if kind not in TYPES:
        raise ValueError(f"attribute 'to' must be float32, uint8, int32, int64 or bool, got type {kind}")
    return [Value(kind, value.shape, value.known if kind == value.kind else None)]


def _clip(step: Step) -> list[Value]:
    step.expect(1, 3)
    for k in (1, 2):
        bound = step.optional(k, FLOAT)
        if bound is not None and bound.shape != ():
            raise ValueError("bounds must be single numbers")
    return [Value(FLOAT, step.value(0, FLOAT).shape)]


ELEMENTWISE: Mapping[str, Check] = {
    **dict.fromkeys(
        ("Abs", "Erf", "Exp", "HardSwish", "Log", "Neg", "Relu", "Sigmoid", "Softplus", "Sqrt", "Tanh"), _single
    ),
    **dict.fromkeys(("Celu", "Elu", "LeakyRelu"), _with_numbers("alpha")),
    **dict.fromkeys(("Max", "Min"), _extreme),
    **dict.fromkeys(("Greater", "GreaterOrEqual", "Less", "LessOrEqual"), _comparison),
    **dict.fromkeys(("And", "Or"), _logical(2)),
    "Add": _arithmetic(add),
    "Cast": _cast,
    "Clip": _clip,
    "Div": _arithmetic(divide),
    "Equal": _arithmetic(lambda a, b: int(a == b), BOOL),
    "Gelu": _gelu,
    "Identity": _identity,
    "Mod": _remainder,
    "Mul": _arithmetic(multiply),
    "Not": _logical(1),
    "Pow": _power,
    "Selu": _with_numbers("alpha", "gamma"),
    "Sub": _arithmetic(subtract),
    "Where": _where,
}
"""Checks of the operators by name."""
