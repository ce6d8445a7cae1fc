"""Arrays in nested values: states and estimates as flat dictionaries, and arguments with one array replaced."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeAlias

import numpy as np

Path: TypeAlias = tuple[str, ...]
"""Keys, fields and indices that lead to an array in a nested value."""


def numbers_in(value: Any, path: Path = ()) -> list[tuple[Path, np.ndarray]]:
    """Return the arrays and numbers of a nested value with their paths; other objects are left out.

    Args:
        value: Mappings, tuples, lists, NamedTuples and dataclasses of arrays and numbers.
        path: Path of the value itself.
    """
    found: list[tuple[Path, np.ndarray]] = []
    _collect(value, path, found)
    return found


def views(value: Any) -> dict[str, np.ndarray]:
    """The arrays in a nested value by their dotted paths."""
    return {".".join(path): array for path, array in numbers_in(value)}


def flat(value: Any) -> dict[str, np.ndarray]:
    """Copies of the arrays in a nested value by their dotted paths."""
    return {path: array.copy() for path, array in views(value).items()}


def replaced(value: Any, path: Path, new: Any) -> Any:
    """Return a nested value with the item at a path replaced; the given value stays as it is."""
    if not path:
        return new
    key, rest = path[0], path[1:]
    parts = dict(_parts(value))
    parts[key] = replaced(parts[key], rest, new)
    if isinstance(value, Mapping):
        return parts
    if hasattr(value, "_fields"):
        return type(value)(**parts)
    return type(value)(parts.values())


def mapped(value: Any, change: Callable[[np.ndarray], np.ndarray], kept: Container[str] = ()) -> Any:
    """Return nested mappings and tuples with a function applied to every array.

    Args:
        value: Nested value; it stays as it is.
        change: Function of an array.
        kept: Keys and fields whose arrays stay as they are.
    """
    for path, array in numbers_in(value):
        if not any(key in kept for key in path):
            value = replaced(value, path, change(array))
    return value


def _collect(value: Any, path: Path, found: list[tuple[Path, np.ndarray]]) -> None:
    if isinstance(value, np.ndarray):
        found.append((path, value))
    elif isinstance(value, (np.generic, bool, int, float, complex)):
        found.append((path, np.asarray(value)))
    else:
        for key, item in _parts(value):
            _collect(item, (*path, key), found)


def _parts(value: Any) -> Iterable[tuple[str, Any]]:
    if isinstance(value, (tuple, list)):
        return zip(value._fields if hasattr(value, "_fields") else map(str, range(len(value))), value, strict=True)
    if value is None or isinstance(value, str):
        return ()
    if isinstance(value, Mapping):
        return ((str(key), item) for key, item in value.items())
    if is_dataclass(value) and not isinstance(value, type):
        return ((field.name, getattr(value, field.name)) for field in fields(value))
    return ()
