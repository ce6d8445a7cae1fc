"""Strict reader of ONNX files: everything in a file is understood or refused, within bounds of time and memory.

The reader knows the part of the format that networks of this package need, and refuses everything else by name.
Therefore onnxruntime cannot find anything in an accepted file that is not in its `Network`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.onnx_file.protobuf import Budget, Field, Table, read_message

MOST_FIELDS = 100_000
"""Largest number of fields in a file; it bounds the time of reading to a second."""
MOST_NODES = 1000
"""Largest number of nodes of a network."""
MOST_WEIGHTS = 500
"""Largest number of initializers of a network."""
MOST_AXES = 6
"""Largest number of axes of a tensor."""
LARGEST_AXIS = 2**24
"""Largest extent of an axis of a tensor."""
LARGEST_WEIGHT = 20_000_000
"""Largest size of one tensor in a file, bytes."""
OPSETS = range(13, 24)
"""Accepted versions of the operators."""
IR_VERSIONS = range(7, 14)
"""Accepted versions of the file format."""

FLOAT, UINT8, INT32, INT64, BOOL = 1, 2, 6, 7, 9
"""Types of tensors, as ONNX numbers them."""
TYPES: Mapping[int, np.dtype[Any]] = {
    FLOAT: np.dtype("<f4"),
    UINT8: np.dtype("u1"),
    INT32: np.dtype("<i4"),
    INT64: np.dtype("<i8"),
    BOOL: np.dtype("bool"),
}
"""Accepted types of tensors."""


class Tensor(NamedTuple):
    """A tensor that is stored in a file.

    Attributes:
        kind: Type, a key of `TYPES`.
        values: Content, a read-only view into the file where possible.
    """

    kind: int
    values: NDArray[Any]


class Node(NamedTuple):
    """A node of a network.

    Attributes:
        operator: Name of its operator in ONNX's own domain.
        inputs: Names of its inputs, "" for an omitted one.
        outputs: Names of its outputs, "" for an omitted one.
        attributes: Attributes by name: int, float, bytes, lists of int or float, or a `Tensor`.
    """

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


class Port(NamedTuple):
    """An input or output of a network, or a declared intermediate tensor.

    Attributes:
        name: Name.
        kind: Type, a key of `TYPES`.
        shape: Extents, names for unknown ones; None where the file declares no shape.
    """

    name: str
    kind: int
    shape: tuple[int | str, ...] | None


@dataclass(frozen=True)
class Network:
    """Content of an ONNX file.

    Attributes:
        opset: Version of the operators.
        nodes: Nodes in the order of the file.
        weights: Initializers by name.
        inputs: Inputs in the order of the file.
        outputs: Outputs in the order of the file.
        declared: Types and shapes that the file declares for intermediate tensors.
    """

    opset: int
    nodes: tuple[Node, ...]
    weights: Mapping[str, Tensor]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    declared: tuple[Port, ...]


def read_network(content: bytes) -> Network:
    """Read an ONNX file.

    Args:
        content: The file.

    Raises:
        ValueError: Not ONNX, or something that networks of this package do not need; the message names it.
    """
    if content[4:8] == b"ORTM":
        # onnxruntime takes such a file for one of its own format.
        raise ValueError("the file is in onnxruntime's own format")
    model = read_message(_MODEL, memoryview(content), "the file", Budget(MOST_FIELDS))
    if model.get("ir_version") not in IR_VERSIONS:
        raise ValueError(
            f"ir_version must lie in {IR_VERSIONS.start} to {IR_VERSIONS[-1]}, got {model.get('ir_version')}"
        )
    imports = model.get("opset_import", [])
    domains = [found.get("domain", "") for found in imports]
    if foreign := [domain for domain in domains if domain]:
        raise ValueError(f"opset_import names the domain {foreign[0]!r}; only ONNX's own operators are allowed")
    if len(imports) != 1 or imports[0].get("version") not in OPSETS:
        versions = [found.get("version") for found in imports]
        raise ValueError(f"opset_import must be one version in {OPSETS.start} to {OPSETS[-1]}, got {versions}")
    if "graph" not in model:
        raise ValueError("the file holds no graph")
    graph = model["graph"]
    weights = [_tensor(tensor, f"initializer {tensor.get('name', '')!r}") for tensor in graph.get("initializer", [])]
    names = [tensor.get("name", "") for tensor in graph.get("initializer", [])]
    if len(set(names)) != len(names) or "" in names:
        raise ValueError("initializers must have names of their own")
    return Network(
        imports[0]["version"],
        tuple(_node(node) for node in graph.get("node", [])),
        dict(zip(names, weights, strict=True)),
        *(tuple(_port(port, what) for port in graph.get(what, [])) for what in ("input", "output", "value_info")),
    )


def _node(node: Mapping[str, Any]) -> Node:
    operator = node.get("op_type", "")
    what = f"node {operator}"
    if node.get("domain"):
        raise ValueError(f"{what} is of the domain {node['domain']!r}; only ONNX's own operators are allowed")
    attributes: dict[str, Any] = {}
    for attribute in node.get("attribute", []):
        name = attribute.get("name", "")
        if name in attributes:
            raise ValueError(f"{what} has the attribute {name!r} twice")
        attributes[name] = _attribute(attribute, f"{what}, attribute {name!r}")
    return Node(operator, tuple(node.get("input", [])), tuple(node.get("output", [])), attributes)


_ATTRIBUTE_TYPES = {1: "f", 2: "i", 3: "s", 4: "t", 6: "floats", 7: "ints"}
"""Field that holds the value of an attribute, by its type."""


def _attribute(attribute: Mapping[str, Any], what: str) -> Any:
    field = _ATTRIBUTE_TYPES.get(attribute.get("type", 0))
    held = [name for name in attribute if name not in ("name", "type")]
    if field is None or held not in ([field], []):
        raise ValueError(f"{what} must be one number, text, tensor, or list of numbers, got {held or 'nothing'}")
    # Writers leave out a value of zero and an empty list.
    value = attribute.get(field, {"f": 0.0, "i": 0, "s": b"", "floats": [], "ints": []}.get(field))
    if field != "t":
        return value
    if value is None:
        raise ValueError(f"{what} holds no tensor")
    return _tensor(value, what)


def _tensor(tensor: Mapping[str, Any], what: str) -> Tensor:
    kind, dims = tensor.get("data_type", 0), tensor.get("dims", [])
    if kind not in TYPES:
        raise ValueError(f"{what} must be of type float32, uint8, int32, int64 or bool, got type {kind}")
    if tensor.get("data_location", 0) != 0:
        raise ValueError(f"{what} has external data; weights must be in the file itself")
    _check_extents(dims, what)
    dtype, count = TYPES[kind], int(np.prod(dims, dtype=object))
    if count * dtype.itemsize > LARGEST_WEIGHT:
        raise ValueError(f"{what} has {count} elements, more than {LARGEST_WEIGHT} bytes")
    field = {FLOAT: "float_data", INT64: "int64_data"}.get(kind, "int32_data")
    held = [name for name in ("raw_data", "float_data", "int32_data", "int64_data") if name in tensor]
    if held not in ([], ["raw_data"], [field]):
        raise ValueError(f"{what} must hold its values once, in raw_data or {field}, got {', '.join(held)}")
    data: Any = tensor.get(held[0], []) if held else []
    if held == ["raw_data"]:
        if len(data) != count * dtype.itemsize:
            raise ValueError(f"{what} must have {count * dtype.itemsize} bytes for shape {dims}, got {len(data)}")
        values = np.frombuffer(data, dtype)
        if kind == BOOL and (np.frombuffer(data, np.uint8) > 1).any():
            raise ValueError(f"{what} must hold 0 or 1")
    else:
        if len(data) != count:
            raise ValueError(f"{what} must have {count} values for shape {dims}, got {len(data)}")
        low, high = (0, 1) if kind in (FLOAT, BOOL) else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        if kind != FLOAT and not all(low <= value <= high for value in data):
            raise ValueError(f"{what} holds values beyond its type")
        values = np.array(data, dtype)
    return Tensor(kind, values.reshape([int(extent) for extent in dims]))


def _check_extents(dims: list[int], what: str) -> None:
    if len(dims) > MOST_AXES or not all(0 <= extent <= LARGEST_AXIS for extent in dims):
        raise ValueError(f"{what} must have at most {MOST_AXES} axes of at most {LARGEST_AXIS}, got {dims[:9]}")


def _port(port: Mapping[str, Any], what: str) -> Port:
    name = port.get("name", "")
    what = f"{what} {name!r}"
    tensor = port.get("type", {}).get("tensor_type")
    if not name or tensor is None or tensor.get("elem_type", 0) not in TYPES:
        raise ValueError(f"{what} must be a named tensor of type float32, uint8, int32, int64 or bool")
    if "shape" not in tensor:
        return Port(name, tensor["elem_type"], None)
    shape: list[int | str] = []
    for extent in tensor["shape"].get("dim", []):
        if len(extent) > 1:
            raise ValueError(f"{what} has an axis with a number and a name")
        shape.append(extent.get("dim_value", extent.get("dim_param", "")))
    _check_extents([extent for extent in shape if isinstance(extent, int)], what)
    if len(shape) > MOST_AXES:
        raise ValueError(f"{what} must have at most {MOST_AXES} axes, got {len(shape)}")
    return Port(name, tensor["elem_type"], tuple(shape))


_IGNORED = MOST_FIELDS
_ENTRY_OF_OPSETS: Table = {1: Field("domain", "text"), 2: Field("version", "int")}
_TENSOR: Table = {
    1: Field("dims", "int", MOST_AXES + 1), 2: Field("data_type", "int"), 3: Field("segment", "refused"),
    4: Field("float_data", "float", MOST_FIELDS), 5: Field("int32_data", "int", MOST_FIELDS),
    6: Field("string_data", "refused"), 7: Field("int64_data", "int", MOST_FIELDS), 8: Field("name", "text"),
    9: Field("raw_data", "bytes"), 10: Field("double_data", "refused"), 11: Field("uint64_data", "refused"),
    12: Field("doc_string", "ignored"), 13: Field("external_data", "refused"), 14: Field("data_location", "int"),
    16: Field("metadata_props", "ignored", _IGNORED),
}  # fmt: skip
_ATTRIBUTE: Table = {
    1: Field("name", "text"), 2: Field("f", "float"), 3: Field("i", "int"), 4: Field("s", "bytes"),
    5: Field("t", _TENSOR), 6: Field("g (a subgraph)", "refused"), 7: Field("floats", "float", 1000),
    8: Field("ints", "int", 1000), 9: Field("strings", "refused"), 10: Field("tensors", "refused"),
    11: Field("graphs (subgraphs)", "refused"), 13: Field("doc_string", "ignored"), 14: Field("tp", "refused"),
    15: Field("type_protos", "refused"), 20: Field("type", "int"), 21: Field("ref_attr_name", "refused"),
    22: Field("sparse_tensor", "refused"), 23: Field("sparse_tensors", "refused"),
}  # fmt: skip
_NODE: Table = {
    1: Field("input", "text", 100), 2: Field("output", "text", 100), 3: Field("name", "ignored"),
    4: Field("op_type", "text"), 5: Field("attribute", _ATTRIBUTE, 30), 6: Field("doc_string", "ignored"),
    7: Field("domain", "text"), 8: Field("overload (of a local function)", "refused"),
    9: Field("metadata_props", "ignored", _IGNORED), 10: Field("device_configurations", "refused"),
}  # fmt: skip
_EXTENT: Table = {1: Field("dim_value", "int"), 2: Field("dim_param", "text"), 3: Field("denotation", "refused")}
_SHAPE: Table = {1: Field("dim", _EXTENT, MOST_AXES + 1)}
_TENSOR_TYPE: Table = {1: Field("elem_type", "int"), 2: Field("shape", _SHAPE)}
_TYPE: Table = {
    1: Field("tensor_type", _TENSOR_TYPE), 4: Field("sequence_type", "refused"), 5: Field("map_type", "refused"),
    6: Field("denotation", "refused"), 7: Field("opaque_type", "refused"),
    8: Field("sparse_tensor_type", "refused"), 9: Field("optional_type", "refused"),
}  # fmt: skip
_PORT: Table = {
    1: Field("name", "text"), 2: Field("type", _TYPE), 3: Field("doc_string", "ignored"),
    4: Field("metadata_props", "ignored", _IGNORED),
}  # fmt: skip
_GRAPH: Table = {
    1: Field("node", _NODE, MOST_NODES), 2: Field("name", "ignored"),
    5: Field("initializer", _TENSOR, MOST_WEIGHTS), 10: Field("doc_string", "ignored"),
    11: Field("input", _PORT, 10), 12: Field("output", _PORT, 10), 13: Field("value_info", _PORT, 10 * MOST_NODES),
    14: Field("quantization_annotation", "refused"), 15: Field("sparse_initializer", "refused"),
    16: Field("metadata_props", "ignored", _IGNORED),
}  # fmt: skip
_MODEL: Table = {
    1: Field("ir_version", "int"), 2: Field("producer_name", "ignored"), 3: Field("producer_version", "ignored"),
    4: Field("domain", "ignored"), 5: Field("model_version", "ignored"), 6: Field("doc_string", "ignored"),
    7: Field("graph", _GRAPH), 8: Field("opset_import", _ENTRY_OF_OPSETS, 10),
    14: Field("metadata_props", "ignored", _IGNORED), 20: Field("training_info", "refused"),
    25: Field("functions (local functions)", "refused"), 26: Field("configuration", "refused"),
}  # fmt: skip
