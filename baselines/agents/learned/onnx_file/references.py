"""Check that an ONNX file refers to no other file. onnxruntime would read them from the working directory."""

from __future__ import annotations

from servotrack.baselines.agents.learned.onnx_file.protobuf import Budget, iterate_fields

_MOST_FIELDS = 3_000_000
"""Largest number of fields in a file; it bounds the time of reading to some seconds."""
_BYTES = 2
_DEEPEST = 20
"""Largest depth of messages."""
_GRAPH, _NODE, _ATTRIBUTE, _TENSOR, _SPARSE, _FUNCTION, _MODEL = range(7)
_INSIDE = {
    _MODEL: {7: _GRAPH, 25: _FUNCTION},
    _GRAPH: {1: _NODE, 5: _TENSOR, 15: _SPARSE},
    _FUNCTION: {7: _NODE},
    _NODE: {5: _ATTRIBUTE},
    _ATTRIBUTE: {5: _TENSOR, 6: _GRAPH, 10: _TENSOR, 11: _GRAPH, 22: _SPARSE, 23: _SPARSE},
    _SPARSE: {1: _TENSOR, 2: _TENSOR},
}
"""Messages in messages by the number of their field, as far as tensors can be in them."""
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14


def check_self_contained(content: bytes) -> None:
    """Raise ValueError unless a file is in ONNX format and holds all its weights.

    Args:
        content: The file.
    """
    if content[4:8] == b"ORTM":
        raise ValueError("the file is in onnxruntime's own format; export it as ONNX")
    try:
        _check(_MODEL, memoryview(content), Budget(_MOST_FIELDS), 0)
    except _ExternalError:
        raise
    except ValueError as error:
        raise ValueError(f"it is not an ONNX file, or damaged ({error})") from error


class _ExternalError(ValueError):
    """Weights in another file."""


def _check(kind: int, data: memoryview, budget: Budget, depth: int) -> None:
    if depth > _DEEPEST:
        raise ValueError("messages are nested too deeply")
    for number, encoding, value in iterate_fields(data, budget):
        if kind == _TENSOR:
            if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value):
                raise _ExternalError("its weights are in another file; export them into one file")
            continue
        inner = _INSIDE[kind].get(number)
        if inner is not None:
            if encoding != _BYTES:
                raise ValueError(f"field {number} is encoded as another type")
            _check(inner, value, budget, depth + 1)
