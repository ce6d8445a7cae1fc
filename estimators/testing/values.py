"""Arrays in nested values: states and estimates as flat dictionaries, and arguments with one array replaced."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeAlias

import numpy as np

Path: TypeAlias = tuple[str, ...]
"""Keys, fields and indices that lead to an array in a nested value."""


def numbers_in(value: Any, path: Path = ()) -> Iterator[tuple[Path, np.ndarray]]:
    """Yield the arrays and numbers of a nested value with their paths; other objects are left out.

    Args:
        value: Mappings, tuples, lists, NamedTuples and dataclasses of arrays and numbers.
        path: Path of the value itself.
    """
    if isinstance(value, (np.ndarray, np.generic, bool, int, float, complex)):
        yield path, np.asarray(value)
        return
    for key, item in _parts(value):
        yield from numbers_in(item, (*path, key))


def flat(value: Any) -> dict[str, np.ndarray]:
    """Copies of the arrays in a nested value by their dotted paths."""
    return {".".join(path): np.array(array) for path, array in numbers_in(value)}


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
    for path, array in list(numbers_in(value)):
        if not any(key in kept for key in path):
            value = replaced(value, path, change(array))
    return value


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield str(key), item
    elif hasattr(value, "_fields"):
        yield from zip(value._fields, value, strict=True)
    elif isinstance(value, (tuple, list)):
        for index, item in enumerate(value):
            yield str(index), item
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield field.name, getattr(value, field.name)
