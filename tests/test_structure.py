"""Structure of the package, measured on its own sources: imports, rooms, signatures, constants."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "servotrack": "package",
    "servotrack.envs": "envs",
    "servotrack.estimators": "estimators",
    "servotrack.baselines": "baselines",
}
MOST_ARROWS = 48
"""Four for each room at most."""
MOST_POSITIONAL = 12
MOST_NUMBERS = 40
ESTIMATOR_NAMES = {"estimator", "tracker", "detector", "filter", "inner"}


def _modules() -> dict[str, Path]:
    """Files of the package by their dotted names."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


MODULES = _modules()
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def _imports(name: str) -> set[str]:
    """Modules of the package that a module imports anywhere, inside functions and for type checking too."""
    found = set()
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            assert node.level == 0, f"{name} imports relatively; imports are absolute here"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in MODULES else node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return {module for module in found if module in MODULES and module != name}


IMPORTS = {name: _imports(name) for name in MODULES}


def circles(graph: Mapping[str, set[str]]) -> Iterator[list[str]]:
    """Strongly connected components of more than one node (R. Tarjan, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = []
            while not component or component[-1] != node:
                component.append(stack.pop())
            if len(component) > 1:
                found.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    yield from found


def test_the_search_finds_circles() -> None:
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == [["a", "b", "c"]]
    assert list(circles({"a": {"b"}, "b": set()})) == []


def test_no_import_circle() -> None:
    assert list(circles(IMPORTS)) == []


def test_rooms_of_baselines_are_few_and_their_arrows_run_one_way() -> None:
    def room(name: str) -> str | None:
        parts = name.split(".")
        return parts[2] if parts[:2] == ["servotrack", "baselines"] and len(parts) > 2 else None

    rooms: dict[str, set[str]] = {found: set() for name in MODULES if (found := room(name))}
    for name, imported in IMPORTS.items():
        if (here := room(name)) is not None:
            rooms[here] |= {there for other in imported if (there := room(other)) not in (None, here)}  # type: ignore[misc]
    assert len(rooms) <= 12, sorted(rooms)
    assert sum(map(len, rooms.values())) <= MOST_ARROWS
    assert list(circles(rooms)) == []


@pytest.mark.parametrize("room", sorted(FOLDERS))
def test_signatures_are_short(room: str) -> None:
    for name, tree in TREES.items():
        if max((package for package in FOLDERS if f"{name}.".startswith(f"{package}.")), key=len) != room:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                names = [a.arg for a in (*node.args.posonlyargs, *node.args.args) if a.arg not in ("self", "cls")]
                # Options of a command are keywords: Typer names them.
                if ".commands." not in name:
                    assert len(names) <= MOST_POSITIONAL, f"{name}:{node.name} has {len(names)} positional parameters"


def test_parameters_that_hold_an_estimator_are_typed() -> None:
    untyped = [
        f"{name}:{node.lineno} {node.arg}"
        for name, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.arg)
        and node.arg.rpartition("_")[2] in ESTIMATOR_NAMES
        and isinstance(node.annotation, ast.Name)
        and node.annotation.id == "Any"
    ]
    assert not untyped


def test_thresholds_of_estimators_are_fields() -> None:
    def is_number(node: ast.expr) -> bool:
        if isinstance(node, ast.UnaryOp):
            return is_number(node.operand)
        if isinstance(node, ast.Tuple):
            return bool(node.elts) and all(map(is_number, node.elts))
        return (
            isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
        )

    numbers = [
        f"{name}:{statement.lineno}"
        for name, tree in TREES.items()
        if name.startswith("servotrack.estimators")
        for statement in tree.body
        if isinstance(statement, (ast.Assign, ast.AnnAssign))
        and statement.value is not None
        and is_number(statement.value)
    ]
    assert len(numbers) <= MOST_NUMBERS, f"{len(numbers)} module-level numbers: {numbers}"
