"""Viterbi algorithm: the most probable path of a chain."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.hmm.chain import Chain
from servotrack.estimators.types import Labels
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


def best_path(chain: Chain, log_likelihood: ArrayLike) -> tuple[Labels, float]:
    """Find the path of largest probability under a uniform prior.

    Args:
        chain: Markov chain of S states.
        log_likelihood: Log likelihood of each row under each state. Shape (T, W), with W = S or a divisor of it, see
            `smooth`.

    Returns:
        The states, shape (T,), and the log probability of the path (rows and transitions without the prior).

    Raises:
        ValueError: The shape is wrong, there are no rows, or a value is not finite or beyond 1e30.
    """
    rows = as_numbers("log_likelihood", log_likelihood)
    if rows.ndim != 2 or rows.shape[0] == 0 or rows.shape[1] == 0 or chain.states % rows.shape[1]:
        raise ValueError(
            f"log_likelihood must have shape (rows, W) with W a divisor of {chain.states} states, got {rows.shape}"
        )
    check_within("log_likelihood", rows, LIMITS.powers, "limit likelihoods of 0 from below")
    back = np.empty((len(rows), chain.states), np.int32)
    value = _forward(chain.runs, np.log(chain.runs.weight), rows, back)
    path = np.empty(len(rows), np.int64)
    path[-1] = int(value.argmax())
    for k in range(len(rows) - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path, float(value.max())


@njit(cache=True, nogil=True)
def _forward(runs, log_weight, rows, back):  # type: ignore[no-untyped-def]
    """Largest log probability of a path to each state; `back` receives each state's predecessor."""
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
