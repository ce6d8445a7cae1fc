"""Hostile cards and networks: each is refused by name, nothing in it runs, within 5 s and 1 GB.

The file is also the program that the tests start: `python test_hostile_files.py FOLDER...` loads the agents in folders,
one process each, and prints what happened.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines.agents.learned.card import AgentFileError, LearnedCard, digest
from servotrack.baselines.agents.learned.marker_network import open_marker_network
from servotrack.baselines.agents.learned.onnx_file.check import MOST_WORK
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.registry import agent_card, create_agent

resource = pytest.importorskip("resource")
onnx = pytest.importorskip("onnx")

ROWS, SECONDS, MEMORY = ServoEncoding().size, 5, 10**9
EXECUTED = "executed"
EVIL = (
    f"from pathlib import Path\nPath(__file__).with_name({EXECUTED!r}).touch()\n\ndef make(*args):\n    return None\n"
)


# Networks.


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


# Cards.


def with_encoding(**encoding: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda card: card | {"encoding": {"kind": "servo", **encoding}}


def with_fields(**fields: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda card: card | fields


def with_text(old: str, new: str) -> Callable[[dict[str, Any]], bytes]:
    return lambda card: json.dumps(card).replace(old, new).encode()


CARDS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "code as residual": (with_encoding(residual="evil:make"), "encoding.residual must be the name"),
    "code as follower": (with_encoding(follower="evil:make"), "encoding.follower must be the name"),
    "code as servo": (with_encoding(kind="marker", image_size=96, servo="evil:make"), "encoding.servo must be the n"),
    "code as law": (with_encoding(kind="jacobian", law="evil:make"), "encoding.law must be one of"),
    "code as eyes": (with_encoding(eyes="evil:make"), "encoding.eyes must be the name"),
    "code as environment": (with_fields(env_id="evil:Arm-v0"), "env_id must be"),
    "code as kind": (with_encoding(kind="evil:make"), "encoding.kind must be one of"),
    "a path as residual": (with_encoding(residual="agent.json"), "encoding.residual must be the name"),
    "a path as eyes": (with_encoding(eyes="../agent"), "encoding.eyes must be the name"),
    "an absolute path as eyes": (with_encoding(eyes="/etc/passwd"), "encoding.eyes must be the name"),
    "itself as eyes": (with_encoding(eyes="agent"), "encoding with eyes needs the observations image"),
    "eyes behind a follower": (with_encoding(eyes="agent", follower="phd-servo"), "not have both follower and eyes"),
    "itself as servo": (with_encoding(kind="marker", image_size=96, servo="agent.json"), "encoding.servo must be"),
    "an agent that sees the truth": (with_encoding(residual="oracle"), "encoding.residual must be the name"),
    "a learned agent as residual": (with_encoding(residual="ppo"), "encoding.residual must be the name"),
    "10^8 observations back": (with_encoding(lags=[10**8]), r"encoding.lags\[0\] must be a whole number in 1 to 1000"),
    "10^5 lags": (with_encoding(lags=list(range(1, 10**5))), "encoding.lags must be a list of 0 to 32"),
    "lags in any order": (with_encoding(lags=[3, 1]), "encoding.lags must be .*ascending"),
    "10^9 frames": (with_encoding(frames=10**9), "encoding.frames must be a whole number in 1 to 64"),
    "10^6 pixels": (with_encoding(kind="marker", image_size=10**6, servo="kf"), "encoding.image_size"),
    "10^9 neighbors": (lambda card: card | {"encoding": {"kind": "set", "neighbors": 10**9}}, "encoding.neighbors"),
    "10^12 numbers of memory": (with_fields(memory=10**12), "memory must be a whole number in 0 to 65536"),
    "true as a number": (with_fields(memory=True), "memory must be a whole number"),
    "10^6 levels": (with_fields(levels=[1] * 10**5), "levels must be a list of 0 to 100"),
    "not a number": (with_text('"lags": [1]', '"ages": [NaN]'), "NaN is not a number"),
    "infinity": (with_text('"lags": [1]', '"ages": [-Infinity]'), "-Infinity is not a number"),
    "10^400": (with_text('"lags": [1]', '"ages": [1e400]'), "too large"),
    "10^400 in digits": (with_text('"lags": [1]', f'"lags": [1{"0" * 400}]'), "too large"),
    "10^6 digits": (with_text('"lags": [1]', f'"lags": [{"9" * 10**6}]'), "too large"),
    "a key twice": (with_text('"lags": [1]', '"residual": "kf", "residual": "evil:make"'), "'residual' appears twice"),
    "10^5 levels of nesting": (with_text('"lags": [1]', f'"lags": {"[" * 10**5}'), "nested deeper than 32"),
    "forty levels of nesting": (with_text('"lags": [1]', f'"lags": {"[" * 40}{"]" * 40}'), "nested deeper than 32"),
    "half a surrogate pair": (with_text("linear", "\\ud800"), "surrogates"),
    "not UTF-8": (lambda card: json.dumps(card).encode().replace(b"linear", b"line\xff"), "agent.json is not valid JS"),
    "3 MB": (with_fields(training={"notes": "x" * 3_000_000}), "more than 2000000 bytes"),
    "a list as kind": (with_encoding(kind=["servo"]), "encoding.kind must be one of"),
    "a list as encoding": (with_fields(encoding=["servo"]), "encoding must be a mapping"),
    "a misspelled field": (with_encoding(lag=[1]), "encoding.lag is not a known field; did you mean 'lags'"),
    "a field of Python": (with_fields(__class__="evil"), "__class__ is not a known field"),
    "terminal commands": (with_fields(summary="\x1b]0;evil\x07"), "summary must be a printable text"),
    "a network above it": (with_fields(network="../agent.onnx"), "network must be the name"),
    "a network anywhere": (with_fields(network="/dev/zero.onnx"), "network must be the name"),
    "a network that is no name": (with_fields(network="agent\0.onnx"), "network must be the name"),
    "another digest": (with_fields(sha256="0" * 64), "sha256 is another one"),
    "no digest": (lambda card: {name: card[name] for name in card if name != "sha256"}, "sha256 is missing"),
    "another version": (with_fields(format_version=True), "format version True"),
    "arguments that are no names": (with_fields(env_kwargs={"a.b": 1}), "env_kwargs"),
}  # fmt: skip


def write_plain(folder: Path, content: bytes = PLAIN, **fields: Any) -> dict[str, Any]:
    """Write a linear network and its card, and return the card; both are valid unless the arguments are not."""
    card = LearnedCard(
        "linear", "a linear network", "UncalibServo-v0", {"level": 3}, {"kind": "servo", "lags": [1]}, "agent.onnx",
        digest(content), **fields,
    )  # fmt: skip
    (folder / "agent.onnx").write_bytes(content)
    (folder / "agent.json").write_text(card.as_json())
    (folder / "evil.py").write_text(EVIL)
    document: dict[str, Any] = json.loads(card.as_json())
    return document


def hostile_card(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    changed = change(write_plain(folder))
    (folder / "agent.json").write_bytes(changed if isinstance(changed, bytes) else json.dumps(changed).encode())


def hostile_network(folder: Path, content: bytes) -> None:
    document = write_plain(folder, content)
    document["encoding"] = {"kind": "servo"}
    (folder / "agent.json").write_text(json.dumps(document))


def as_link(folder: Path, name: str, target: str) -> None:
    write_plain(folder)
    if Path(target).is_absolute():
        (folder / name).unlink()
    else:
        (folder / name).rename(folder / target)
    (folder / name).symlink_to(target)


def as_pipe(folder: Path, name: str) -> None:
    write_plain(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)


def as_folder(folder: Path, name: str) -> None:
    write_plain(folder)
    (folder / name).unlink()
    (folder / name).mkdir()


def as_large(folder: Path, name: str) -> None:
    write_plain(folder)
    os.truncate(folder / name, 2**31)


PLACES: dict[str, tuple[Callable[[Path], None], str]] = {
    f"{name} is {what}": (lambda folder, make=make, name=name: make(folder, name), message)
    for name in ("agent.json", "agent.onnx")
    for what, make, message in (
        ("a link to a device", lambda folder, name: as_link(folder, name, "/dev/zero"), "symbolic link"),
        ("a link to a file", lambda folder, name: as_link(folder, name, "other"), "symbolic link"),
        ("a pipe", as_pipe, "not a regular file"),
        ("a folder", as_folder, "cannot be read|not a regular file"),
        ("2 GB long", as_large, "more than 20*000 bytes"),
    )
}

CASES: dict[str, tuple[Callable[[Path], None], str]] = {
    **{
        f"card: {name}": (lambda folder, change=change: hostile_card(folder, change), message)
        for name, (change, message) in CARDS.items()
    },
    **{
        f"network: {name}": (lambda folder, make=make: hostile_network(folder, make()), message)
        for name, (make, message) in NETWORKS.items()
    },
    **{f"place: {name}": case for name, case in PLACES.items()},
}


def load(path: Path, env: Any) -> str:
    """Load an agent, let it act, and return what came of it."""
    try:
        agent = create_agent(agent_card(str(path)), env)
        observation, _ = env.reset(seed=100_000)
        state: Any = None
        for _ in range(2):
            action, state = agent.predict(observation, state)
            observation, *_ = env.step(action)
    except AgentFileError as error:
        return f"refused: {error}"
    return "accepted"


def load_all(folders: list[Path]) -> None:
    """Load the agents in folders, each in a process of its own with bounds, and print one line of JSON for each."""
    env = gym.make("UncalibServo-v0", level=3)
    # So that what the package itself imports and compiles is not counted.
    load(folders[0] / "agent.json", env)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for folder in folders:
        sys.stdout.flush()
        started = time.monotonic()
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
            # The default action ends the process, wherever it is.
            signal.alarm(SECONDS)
            os.chdir(folder)
            sys.path.insert(0, str(folder))
            try:
                outcome = load(folder / "agent.json", env)
            except BaseException as error:
                outcome = f"{type(error).__name__}: {error}"
            (folder / "outcome").write_text(outcome)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps({"status": status, "seconds": time.monotonic() - started}))


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Outcome of every case, from one process that loads all of them."""
    parent = tmp_path_factory.mktemp("hostile")
    folders = [parent / f"case{k}" for k in range(len(CASES) + 1)]
    for folder in folders:
        folder.mkdir()
    hostile_network(folders[0], PLAIN)
    for folder, (make, _) in zip(folders[1:], CASES.values(), strict=True):
        make(folder)
    command = [sys.executable, __file__, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    found = {}
    for name, folder, line in zip(["plain", *CASES], folders, lines, strict=True):
        outcome = folder / "outcome"
        text = outcome.read_text() if outcome.exists() else "nothing"
        found[name] = {**line, "outcome": text, "executed": (folder / EXECUTED).exists(), "folder": folder}
    return found


def test_the_agent_that_all_cases_are_made_of_is_accepted(outcomes: dict[str, dict[str, Any]]) -> None:
    assert outcomes["plain"]["outcome"] == "accepted"


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_refused_by_name(name: str, outcomes: dict[str, dict[str, Any]]) -> None:
    found, (_, message) = outcomes[name], CASES[name]
    assert found["status"] == 0, "the process did not end by itself: time, memory or a crash"
    assert found["seconds"] < SECONDS and not found["executed"]
    assert found["outcome"].startswith("refused: ")
    assert str(found["folder"] / "agent.") in found["outcome"] and len(found["outcome"]) < 1000
    assert re.search(message, found["outcome"]), found["outcome"]


def test_a_card_that_names_itself_ends_by_a_message(tmp_path: Path) -> None:
    hostile_card(tmp_path, with_encoding(eyes="agent"))
    with pytest.raises(AgentFileError, match=r"encoding.eyes names .*agent.json, which is not the card of a marker"):
        open_marker_network("agent", tmp_path)


if __name__ == "__main__":
    load_all([Path(folder) for folder in sys.argv[1:]])
