"""Bound of the size that a network has once its local functions are inlined, which onnxruntime does when it loads it.

Thirty functions that each call the one before twice are a billion nodes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from servotrack.baselines.agents.learned.onnx_file.protobuf import Budget, iterate_fields

MOST_NODES = 200_000
"""Largest number of nodes after inlining. Large detection networks have some thousands."""
_MOST_FIELDS = 3_000_000
_DEEPEST = 50
"""Largest depth of functions in functions, and of graphs in graphs."""
_Name = tuple[bytes, bytes]
"""Domain and name of an operator or function."""


@dataclass
class _Body:
    """Nodes of a function or of the network, those of inner graphs included.

    Attributes:
        called: Number of nodes by operator.
        name: Name of the function.
        domain: Domain of the function.
    """

    called: Counter[_Name] = field(default_factory=Counter)
    name: bytes = b""
    domain: bytes = b""


def check_expansion(content: bytes) -> None:
    """Raise ValueError if a network has too many nodes once functions are inlined, or functions that call themselves.

    Args:
        content: The ONNX file.
    """
    budget, network, functions = Budget(_MOST_FIELDS), _Body(), {}
    for number, _, value in iterate_fields(memoryview(content), budget):
        if number == 7:
            _read_nodes(value, 1, network, budget, 0)
        elif number == 25:
            body = _Body()
            _read_nodes(value, 7, body, budget, 0)
            functions[body.domain, body.name] = body
    if functions:
        _size(network, functions, {}, 0)


def _read_nodes(data: memoryview, of_nodes: int, body: _Body, budget: Budget, depth: int) -> None:
    """Count the nodes of a graph (field 1) or function (field 7); of a function also read name and domain."""
    if depth > _DEEPEST:
        raise ValueError("graphs are nested too deeply")
    for number, _, value in iterate_fields(data, budget):
        if number == of_nodes:
            _read_node(value, body, budget, depth)
        elif of_nodes == 7 and number == 1:
            body.name = bytes(value)
        elif of_nodes == 7 and number == 10:
            body.domain = bytes(value)


def _read_node(data: memoryview, body: _Body, budget: Budget, depth: int) -> None:
    name = domain = b""
    for number, _, value in iterate_fields(data, budget):
        if number == 4:
            name = bytes(value)
        elif number == 7:
            domain = bytes(value)
        elif number == 5:
            for inner, _, graph in iterate_fields(value, budget):
                if inner in (6, 11):
                    _read_nodes(graph, 1, body, budget, depth + 1)
    body.called[domain, name] += 1


def _size(body: _Body, functions: dict[_Name, _Body], known: dict[_Name, int], depth: int) -> int:
    """Return the number of nodes of a body once functions are inlined."""
    if depth > _DEEPEST:
        raise ValueError("functions call themselves, or are nested too deeply; export the network without functions")
    total = 0
    for name, times in body.called.items():
        if name in functions and name not in known:
            known[name] = _size(functions[name], functions, known, depth + 1)
        total += times * known.get(name, 1)
        if total > MOST_NODES:
            raise ValueError(
                f"its functions make more than {MOST_NODES} nodes; export the network without functions (inline them)"
            )
    return total
