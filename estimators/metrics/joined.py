"""One array out of a great many small ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_JOINED_FROM = 4096


class Joined:
    """Collects arrays of one axis and joins them every few thousand: kept one by one, each takes a hundred bytes more.

    Args:
        dtype: Of the whole.
    """

    def __init__(self, dtype: DTypeLike) -> None:
        self._dtype = np.dtype(dtype)
        self._blocks: list[NDArray[Any]] = []
        self._loose: list[NDArray[Any]] = []

    def append(self, values: ArrayLike) -> None:
        """Add values, shape (k,), at the end."""
        self._loose.append(np.asarray(values, self._dtype))
        if len(self._loose) >= _JOINED_FROM:
            self._blocks.append(np.concatenate(self._loose))
            self._loose.clear()

    def array(self) -> NDArray[Any]:
        """All values so far, shape (n,)."""
        return np.concatenate([np.zeros(0, self._dtype), *self._blocks, *self._loose])
