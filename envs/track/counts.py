"""Quantiles of random counts, which set the number of rows of an observation."""

from __future__ import annotations

import math


def poisson_quantile(rate: float, tail: float = 1e-9) -> int:
    """Return the smallest number that a Poisson variable exceeds with a probability below `tail`.

    Args:
        rate: Mean of the Poisson variable.
        tail: Probability that the result is exceeded. Smaller values give larger results.
    """
    if rate == 0.0:
        return 0
    probability, count = math.exp(-rate), 0
    # Beyond the mean a geometric series bounds the tail: P(X > count) <= p(count) r / (1 - r), r = rate / (count + 1).
    while count <= rate or probability * rate / (count + 1.0 - rate) >= tail:
        count += 1
        probability *= rate / count
    return count
