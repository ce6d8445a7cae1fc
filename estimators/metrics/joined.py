"""Concatenation of very many small arrays with little memory overhead."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray


class Joined:
    """Collector of one-dimensional arrays, concatenated in blocks to save about 100 bytes per array.

    Args:
        dtype: Data type of the result.
        block: Number of arrays after which they are concatenated.
    """

    def __init__(self, dtype: DTypeLike, block: int = 4096) -> None:
        self._dtype, self._block = np.dtype(dtype), block
        self._blocks: list[NDArray[Any]] = []
        self._loose: list[NDArray[Any]] = []

    def append(self, values: ArrayLike) -> None:
        """Append values, shape (k,)."""
        self._loose.append(np.asarray(values, self._dtype))
        if len(self._loose) >= self._block:
            self._blocks.append(np.concatenate(self._loose))
            self._loose.clear()

    def array(self) -> NDArray[Any]:
        """Return all values so far, shape (n,)."""
        return np.concatenate([np.zeros(0, self._dtype), *self._blocks, *self._loose])
