"""Networks that a loader must refuse, by name: their bytes and the message that refuses them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from servotrack.baselines.agents.learned.onnx_file.check import MOST_WORK
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding

onnx = pytest.importorskip("onnx")

ROWS = ServoEncoding().size


def value(name: str, *shape: int | str, kind: int = 1) -> Any:
    return onnx.helper.make_tensor_value_info(name, kind, list(shape))


def weights(name: str, array: Any) -> Any:
    return onnx.numpy_helper.from_array(np.asarray(array), name)


def node(operator: str, inputs: str, outputs: str, **attributes: Any) -> Any:
    return onnx.helper.make_node(operator, inputs.split(), outputs.split(), **attributes)


def graph(*nodes: Any, stored: tuple[Any, ...] = (), outputs: tuple[Any, ...] = ()) -> Any:
    """A graph whose nodes end in `last` (n, ROWS), with a linear layer behind it."""
    layer = weights("layer", np.full((ROWS, 2), 0.01, np.float32))
    head = [node("MatMul", "last layer", "action")]
    inputs = [value("observation", "n", ROWS)]
    return onnx.helper.make_graph(
        [*nodes, *head], "hostile", inputs, [value("action", "n", 2), *outputs], [layer, *stored]
    )


def model(subject: Any, opset: int = 20, **fields: Any) -> Any:
    opsets = [onnx.helper.make_opsetid("", opset)]
    return onnx.helper.make_model(subject, opset_imports=fields.pop("opsets", opsets), **{"ir_version": 9, **fields})


def network(*nodes: Any, stored: tuple[Any, ...] = (), **fields: Any) -> bytes:
    return bytes(model(graph(*nodes, stored=stored), **fields).SerializeToString())


PASS = node("Identity", "observation", "last")
PLAIN = network(PASS)


def external(location: str) -> bytes:
    hidden = onnx.TensorProto(name="hidden", data_type=1, dims=[4000, ROWS], data_location=1)
    for key, text in (("location", location), ("offset", "0"), ("length", str(16_000 * ROWS))):
        hidden.external_data.add(key=key, value=text)
    return network(node("ReduceSum", "hidden", "sum", keepdims=1), node("Add", "observation sum", "last"),
                   stored=(hidden,))  # fmt: skip


def _body(*nodes: Any, inputs: tuple[Any, ...] = (), outputs: tuple[Any, ...] = ()) -> Any:
    return onnx.helper.make_graph(list(nodes), "body", list(inputs), list(outputs))


def loop() -> bytes:
    scalar = onnx.helper.make_tensor_value_info
    body = _body(
        node("Identity", "going", "still"), node("Add", "x x", "y"),
        inputs=(scalar("turn", 7, []), scalar("going", 9, []), value("x", "n", ROWS)),
        outputs=(scalar("still", 9, []), value("y", "n", ROWS)),
    )  # fmt: skip
    stored = (weights("turns", np.int64(2**62)), weights("yes", np.bool_(True)))
    return network(node("Loop", "turns yes observation", "last", body=body), stored=stored)


def branch() -> bytes:
    arm = _body(node("Identity", "observation", "z"), outputs=(value("z", "n", ROWS),))
    return network(
        node("If", "yes", "last", then_branch=arm, else_branch=arm), stored=(weights("yes", np.bool_(True)),)
    )


def nested_subgraphs(depth: int) -> bytes:
    """Attribute in node in graph in attribute, as deep as the file allows."""
    inner = b""
    for _ in range(depth):
        inner = field(6, field(1, field(5, field(1, b"g") + inner + varint(20 << 3) + varint(5))))
    attribute = field(1, b"body") + inner
    found = model(graph(PASS))
    found.ClearField("graph")
    return bytes(found.SerializeToString()) + field(7, field(1, field(4, b"Loop") + field(5, attribute)))


def functions() -> bytes:
    """Thirty functions, each of which calls the one before it twice."""
    made = []
    for k in range(30):
        called = "Identity" if k == 0 else f"f{k - 1}"
        calls = [onnx.helper.make_node(called, [a], [b], domain="" if k == 0 else "local") for a, b in ("xy", "yz")]
        opsets = [onnx.helper.make_opsetid("", 20), onnx.helper.make_opsetid("local", 1)]
        made.append(onnx.helper.make_function("local", f"f{k}", ["x"], ["z"], calls, opsets))
    call = onnx.helper.make_node("f29", ["observation"], ["last"], domain="local")
    opsets = [onnx.helper.make_opsetid("", 20), onnx.helper.make_opsetid("local", 1)]
    return bytes(model(graph(call), opsets=opsets, functions=made).SerializeToString())


def shaped(*extents: int) -> tuple[Any, ...]:
    return (weights("shape", np.array(extents, np.int64)),)


def products(count: int) -> bytes:
    """A chain of products of constant matrices, which are computed while the network is loaded."""
    square = weights("m0", np.ones((2000, 2000), np.float32))
    chain = [node("MatMul", f"m{k} m0", f"m{k + 1}") for k in range(count)]
    last = [node("ReduceSum", f"m{count}", "sum", keepdims=1), node("Add", "observation sum", "last")]
    return network(*chain, *last, stored=(square,))


def doubling(count: int) -> bytes:
    chain = [node("Concat", f"x{k} x{k}", f"x{k + 1}", axis=1) for k in range(count)]
    first = node("Identity", "observation", "x0")
    last = [node("ReduceSum", f"x{count} axis", "sum", keepdims=1), node("Add", "observation sum", "last")]
    return network(first, *chain, *last, stored=(weights("axis", np.array([1])),))


def edited(change: Callable[[Any], None], *nodes: Any, stored: tuple[Any, ...] = ()) -> bytes:
    found = onnx.load_model_from_string(network(*(nodes or (PASS,)), stored=stored))
    change(found)
    return bytes(found.SerializeToString())


def varint(number: int) -> bytes:
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number])


def field(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def raw_tensor(**fields: Any) -> Any:
    return onnx.TensorProto(**{"name": "odd", "data_type": 1, **fields})


def _set(subject: Any, name: str, content: Any) -> None:
    setattr(subject, name, content)


SUM = node("Add", "observation odd", "last")
CONV = {"kernel_shape": [1], "strides": [1], "pads": [0, 0], "dilations": [1], "group": 1}


def conv(**attributes: Any) -> bytes:
    inside = node("Conv", "u filters", "v", **{**CONV, **attributes})
    return network(
        node("Unsqueeze", "observation axis", "u"), inside, node("Squeeze", "v axis", "last"),
        stored=(weights("axis", np.array([1])), weights("filters", np.ones((1, 1, 1), np.float32))),
    )  # fmt: skip


NETWORKS: dict[str, tuple[Callable[[], bytes], str]] = {
    "external data beside it": (lambda: external("hidden.bin"), "'hidden'|initializer has external_data"),
    "external data above it": (lambda: external("../hidden.bin"), "external_data"),
    "external data anywhere": (lambda: external("/etc/passwd"), "external_data"),
    "2^62 turns": (loop, "a subgraph"),
    "branches": (branch, "a subgraph"),
    "a bomb of subgraphs": (lambda: nested_subgraphs(3_000), "subgraph"),
    "nested functions": (functions, "local functions"),
    "a foreign domain": (
        lambda: network(onnx.helper.make_node("Evil", ["observation"], ["last"], domain="org.evil")), "org.evil"
    ),
    "a foreign opset": (
        lambda: network(PASS, opsets=[onnx.helper.make_opsetid("", 20), onnx.helper.make_opsetid("org.evil", 1)]),
        "org.evil",
    ),
    "random normal": (
        lambda: network(node("RandomNormal", "", "r", shape=[1, ROWS]), node("Add", "observation r", "last")),
        r"RandomNormal\): the operator",
    ),
    "random like": (lambda: network(node("RandomUniformLike", "observation", "last")), "RandomUniformLike"),
    "bernoulli": (lambda: network(node("Bernoulli", "observation", "last")), "Bernoulli"),
    "4 GB of zeros": (
        lambda: network(
            node("ConstantOfShape", "shape", "z"), node("ReduceSum", "z", "s", keepdims=1),
            node("Add", "observation s", "last"), stored=shaped(10**5, 10**4, 1),
        ),
        r"ConstantOfShape\): .*bytes|operations",
    ),
    "zeros of a shape in the data": (
        lambda: network(
            node("Cast", "observation", "shape", to=7), node("ConstantOfShape", "shape", "z"),
            node("Add", "observation z", "last"),
        ),
        "ConstantOfShape.*constant list",
    ),
    "a range": (
        lambda: network(node("Range", "a b c", "r"), node("Add", "observation r", "last"),
                        stored=(weights("a", 0.0), weights("b", 1e9), weights("c", 1.0))),
        "type float32, uint8",
    ),
    "a range of float32": (
        lambda: network(node("Range", "a a a", "r"), node("Add", "observation r", "last"),
                        stored=(weights("a", np.float32(1e9)),)),
        r"Range\): the operator",
    ),
    "an expansion": (
        lambda: network(
            node("Unsqueeze", "observation axis", "u"), node("Expand", "u shape", "e"),
            node("ReduceSum", "e axis", "last", keepdims=0),
            stored=(*shaped(1, 10**7, ROWS), weights("axis", np.array([1]))),
        ),
        "Expand.*operations|bytes for each row",
    ),
    "tiles": (
        lambda: network(node("Tile", "observation shape", "last"), stored=shaped(1, 10**8)), r"Tile\): the operator"
    ),
    "large products": (lambda: products(900), f"MatMul.*more than {MOST_WORK} operations"),
    "doubled forty times": (lambda: doubling(40), "Concat.*bytes for each row|must have at most"),
    "batch by batch": (
        lambda: network(
            node("Transpose", "observation", "t"), node("MatMul", "observation t", "s"),
            node("MatMul", "s observation", "last"),
        ),
        "square of the number of rows",
    ),
    "rows squared through shapes": (
        lambda: network(
            node("Shape", "observation", "s", end=1), node("Mul", "s s", "q"), node("ConstantOfShape", "q", "z"),
            node("ReduceSum", "z", "r", keepdims=1), node("Add", "observation r", "last"),
        ),
        "Mul.*square of the number of rows",
    ),
    "too many nodes": (
        lambda: network(*[node("Identity", f"x{k}" if k else "observation", f"x{k + 1}") for k in range(5000)],
                        node("Identity", "x5000", "last")),
        "more than 1000 times",
    ),
    "division by zero": (
        lambda: network(node("Div", "a b", "q"), PASS,
                        stored=(weights("a", np.array([1])), weights("b", np.array([0])))),
        "Div.*divisor",
    ),
    "smallest by minus one": (
        lambda: network(node("Div", "a b", "q"), PASS,
                        stored=(weights("a", np.array([-(2**63)])), weights("b", np.array([-1])))),
        "Div.*must be >= 0",
    ),
    "an index beyond": (
        lambda: network(node("Gather", "observation i", "last", axis=1),
                        stored=(weights("i", np.arange(ROWS) + 10**6),)),
        "Gather.*indices must be constants",
    ),
    "strides of zero": (lambda: conv(strides=[0]), "Conv.*strides"),
    "a huge padding": (lambda: conv(pads=[10**9, 0]), "Conv.*pads"),
    "no groups": (lambda: conv(group=0), "Conv.*group"),
    "an unknown attribute": (lambda: conv(evil=1), "Conv.*attribute 'evil'"),
    "a text where numbers are": (lambda: conv(strides="one"), "Conv.*strides"),
    "own activations": (
        lambda: network(node("GRU", "observation w w", "last", hidden_size=2, activations=["Evil"]),
                        stored=(weights("w", np.ones((1, 6, 2), np.float32)),)),
        "strings",
    ),
    "weights that are too short": (
        lambda: network(SUM, stored=(raw_tensor(dims=[ROWS], raw_data=b"\0" * 8),)), "initializer 'odd' must have"
    ),
    "weights beyond memory": (
        lambda: network(SUM, stored=(raw_tensor(dims=[2**24, 2**24, 2**24]),)), "initializer 'odd' has"
    ),
    "negative extents": (
        lambda: network(SUM, stored=(raw_tensor(dims=[-ROWS], raw_data=b"\0" * 4),)), "initializer 'odd' must have"
    ),
    "texts as weights": (
        lambda: network(SUM, stored=(raw_tensor(data_type=8, dims=[1], string_data=[b"evil"]),)), "string_data"
    ),
    "sparse weights": (
        lambda: edited(lambda found: found.graph.sparse_initializer.add()), "sparse_initializer"
    ),
    "a cycle": (
        lambda: network(node("Add", "observation b", "a"), node("Add", "a a", "b"), node("Identity", "b", "last")),
        "not computed before it is used",
    ),
    "one name twice": (lambda: network(node("Neg", "observation", "observation"), PASS), "'observation' is defined tw"),
    "a false declaration": (
        lambda: edited(lambda found: found.graph.value_info.append(value("last", "n", 10**6))), "'last' is declared"
    ),
    "an output of another shape": (
        lambda: edited(lambda found: found.graph.output[0].CopyFrom(value("action", "n", "k", 2))),
        "'action' is declared",
    ),
    "a fixed batch": (
        lambda: edited(lambda found: found.graph.input[0].CopyFrom(value("observation", 64, ROWS))), "the batch"
    ),
    "unknown operators' version": (lambda: network(PASS, opset=999), "opset_import"),
    "an unknown version of the format": (lambda: network(PASS, ir_version=99), "ir_version"),
    "training": (lambda: edited(lambda found: found.training_info.add()), "training_info"),
    "a second graph": (lambda: PLAIN + field(7, b""), "graph twice"),
    "an unknown field": (lambda: PLAIN + field(99, b"evil"), "unknown field 99"),
    "a truncated file": (lambda: PLAIN[:-40], "truncated"),
    "a length beyond the file": (lambda: PLAIN + varint(7 << 3 | 2) + varint(2**62), "truncated"),
    "a number without end": (lambda: PLAIN + b"\x08" + b"\xff" * 10**6, "longer than needed"),
    "a long way of writing 9": (lambda: b"\x08\x89\x80\x80\x00" + PLAIN[2:], "longer than needed"),
    "groups": (lambda: PLAIN + b"\x0b" * 10**6, "unknown encoding"),
    "a million fields": (lambda: PLAIN + field(14, b"") * 10**6, "too many fields"),
    "a name that is not UTF-8": (
        lambda: PLAIN.replace(b"observation", b"observatio\xff"), "UTF-8"
    ),
    "onnxruntime's own format": (lambda: b"\x08\x09\x12\x04ORTM" + PLAIN[2:], "own format"),
    "pickled code": (lambda: b"\x80\x04cos\nsystem\n(S'true'\ntR.", "ONNX"),
    "weights that are not numbers": (
        lambda: network(SUM, stored=(weights("odd", np.full((1, ROWS), np.nan, np.float32)),)),
        "'action' that is not finite",
    ),
    "another row": (lambda: PLAIN.replace(b"observation", b"observatiom"), "observation"),
}  # fmt: skip
