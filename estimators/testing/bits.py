"""Bitwise comparison of nested values, with a description of the first difference."""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from typing import Any

import numpy as np


def first_difference(ours: Any, theirs: Any, where: str) -> str | None:
    """Compare nested dictionaries, tuples, lists, arrays and numbers, types included.

    Args:
        ours: First value, called "here" in the answer.
        theirs: Second value, called "there" in the answer.
        where: Name of the value in the answer.

    Returns:
        A sentence about the first difference, or None if all bits are equal. NaN equals itself, 0.0 differs from -0.0.
    """
    if isinstance(ours, np.ndarray) and isinstance(theirs, np.ndarray):
        return _array_difference(ours, theirs, where)
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        if ours.keys() != theirs.keys():
            return f"{where} has keys {sorted(map(str, ours))} here and {sorted(map(str, theirs))} there"
        pairs = [(f"{where}[{key!r}]", ours[key], theirs[key]) for key in ours]
    elif isinstance(ours, (tuple, list)) and isinstance(theirs, (tuple, list)):
        if len(ours) != len(theirs):
            return f"{where} has length {len(ours)} here and {len(theirs)} there"
        pairs = [(f"{where}[{i}]", a, b) for i, (a, b) in enumerate(zip(ours, theirs, strict=True))]
    elif isinstance(ours, (Mapping, tuple, list)) or isinstance(theirs, (Mapping, tuple, list)):
        return f"{where} is a {type(ours).__name__} here and a {type(theirs).__name__} there"
    else:
        return _array_difference(np.asarray(ours), np.asarray(theirs), where)
    return next((found for name, a, b in pairs if (found := first_difference(a, b, name))), None)


def _array_difference(ours: np.ndarray, theirs: np.ndarray, where: str) -> str | None:
    if ours.dtype != theirs.dtype or ours.shape != theirs.shape:
        return f"{where} is {ours.dtype}{ours.shape} here and {theirs.dtype}{theirs.shape} there"
    if ours.dtype == object:
        if ours.shape == ():
            return (
                None if ours.item() == theirs.item() else f"{where} is {ours.item()!r} here and {theirs.item()!r} there"
            )
        return first_difference(ours.tolist(), theirs.tolist(), where)
    if have_same_bits(ours, theirs):
        return None
    size = ours.dtype.itemsize
    bytes_differ = np.frombuffer(ours.tobytes(), np.uint8) != np.frombuffer(theirs.tobytes(), np.uint8)
    at = np.unravel_index(int(bytes_differ.argmax()) // size, ours.shape)
    place = f"{where}[{', '.join(str(int(i)) for i in at)}]" if ours.shape else where
    return f"{place} is {ours[at].item()!r} here and {theirs[at].item()!r} there"


def have_same_bits(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Compare the types, shapes and bits of two arrays that hold no objects."""
    if ours.dtype != theirs.dtype or ours.shape != theirs.shape:
        return False
    size = ours.dtype.itemsize
    plain = size <= 8 and ours.dtype.kind in "fiub" and ours.flags.c_contiguous and theirs.flags.c_contiguous
    # Two copies of a page are faster than a comparison word by word.
    if plain and ours.nbytes > mmap.PAGESIZE:
        return bool((ours.view(f"u{size}") == theirs.view(f"u{size}")).all())
    return ours.tobytes() == theirs.tobytes()
