"""The single best path of a chain."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.chain import Chain
from servotrack.estimators.types import Labels


def best_path(chain: Chain, log_likelihood: ArrayLike) -> tuple[Labels, float]:
    """States of the path of largest probability, from a uniform prior.

    Args:
        chain: S states.
        log_likelihood: Of each row under each state. Shape (T, W), W = S or a divisor of it as in `smooth`.

    Returns:
        The states, shape (T,), and the path's log probability (of rows and transitions, less that of the prior).

    Raises:
        ValueError: For a wrong shape, no rows, or values that are not finite.
    """
    rows = np.ascontiguousarray(log_likelihood, np.float64)
    if rows.ndim != 2 or rows.shape[0] == 0 or rows.shape[1] == 0 or chain.states % rows.shape[1]:
        raise ValueError(
            f"log_likelihood must have shape (rows, W) with W a divisor of {chain.states} states, got {rows.shape}"
        )
    if not np.isfinite(rows).all():
        raise ValueError("log_likelihood must be finite")
    back = np.empty((len(rows), chain.states), np.int32)
    value = _forward(chain.runs, np.log(chain.runs.weight), rows, back)
    path = np.empty(len(rows), np.int64)
    path[-1] = int(value.argmax())
    for k in range(len(rows) - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path, float(value.max())


@njit(cache=True, nogil=True)
def _forward(runs, log_weight, rows, back):  # type: ignore[no-untyped-def]
    """Largest log probability of a path to each state; `back` has each state's predecessor."""
    T, W = rows.shape
    S = back.shape[1]
    value, best = np.zeros(S), np.empty(S)
    for i in range(S):
        value[i] = rows[0, i % W]
    for k in range(1, T):
        best[:] = -np.inf
        before = back[k]
        before[:] = 0
        for run in range(runs.source.shape[0]):
            source, target, step = runs.source[run], runs.target[run], log_weight[run]
            for i in range(runs.length[run]):
                candidate = value[source + i] + step
                if candidate > best[target + i]:
                    best[target + i] = candidate
                    before[target + i] = source + i
        for i in range(S):
            value[i] = best[i] + rows[k, i % W]
    return value
