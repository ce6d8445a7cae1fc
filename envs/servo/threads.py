"""Compiled work on the rows of a world, shared among threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from servotrack.estimators.types import Array


class Threads:
    """Threads that share a range of indices. Results do not depend on their number. Copies start their own.

    Args:
        count: Number of threads. More pay for compiled work that takes some 0.1 ms or longer.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ThreadPoolExecutor | None = None

    def share(
        self,
        work: Callable[[int, int], Any],
        total: int,
        least: int = 1,
        costs: Array | None = None,
        handover: float = 0.0,
    ) -> None:
        """Call work(first, last) for parts of the range from 0 to before `total`, at most one part per thread.

        Args:
            work: Function of the first index of a part and the one after its last.
            total: Number of indices.
            least: Number of indices that pays for a part of its own.
            costs: Expected time of each index in any unit, positive, (total,); None for 1 each.
            handover: Time until another thread has begun and its end is noticed, in the unit of `costs`. The calling
                thread does so much more of the work.
        """
        parts = min(self.count, total // least)
        if parts <= 1:
            work(0, total)
            return
        bounds = _bounds(np.ones(total) if costs is None else costs, parts, handover)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.count - 1, thread_name_prefix="servotrack")
        (first, last), *others = itertools.pairwise(bounds)
        waiting = [self._pool.submit(work, *other) for other in others]
        work(first, last)
        for part in waiting:
            part.result()

    def __getstate__(self) -> dict[str, Any]:
        """Return the number of threads; the threads themselves cannot be copied."""
        return {"count": self.count, "_pool": None}


def _bounds(costs: Array, parts: int, handover: float) -> list[int]:
    """Divide indices into runs of nearly equal cost, the first one dearer by `handover`.

    Returns where each begins, and the end. Length parts + 1.
    """
    before = costs.cumsum()
    share = max(float(before[-1]) - handover, 0.0) / parts
    wanted = [handover + share * n for n in range(1, parts)]
    # An index belongs to the part in which its middle lies.
    return [0, *(before - 0.5 * costs).searchsorted(wanted).tolist(), len(costs)]
