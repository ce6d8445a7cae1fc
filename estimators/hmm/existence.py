"""Sequential test of existence: probability that a chain's object is present in each row, and spans of presence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, first_bad, is_within


class Span(NamedTuple):
    """Rows `first` to `last`, both included.

    Attributes:
        first: First row.
        last: Last row.
    """

    first: int
    last: int


def presence(existence_likelihood: ArrayLike, switching: float = 0.02, prior: float = 0.5) -> Array:
    """Probability that the object is present in each row given all rows (Jiang and Zhou 2016, eqs. 29 to 33).

    The model is a chain of two states, absent and present, with the row likelihoods 1 and Lam_k.

    Args:
        existence_likelihood: Lam_k, not negative. Shape (T,).
        switching: Probability of a change from row to row. Larger values react faster to appearance and disappearance.
        prior: Probability of presence at the first row.

    Returns:
        Probabilities. Shape (T,).

    Raises:
        ValueError: A likelihood is negative or not finite, or a probability is outside (0, 1).
    """
    ratio = as_numbers("existence_likelihood", existence_likelihood)
    if ratio.ndim != 1:
        raise ValueError(f"existence_likelihood must have shape (T,), got {ratio.shape}; pass one value per row")
    bad = ~(np.isfinite(ratio) & (ratio >= 0.0))
    if bad.any():
        raise ValueError(
            f"existence_likelihood must be finite and >= 0, got {first_bad(ratio, bad)}; leave such rows out"
        )
    for name, value in (("switching", switching), ("prior", prior)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"{name} must lie in (0, 1), got {value!r}")
    out = np.empty(len(ratio))
    _two_states(ratio, switching, prior, out)
    return out


def spans(probability: ArrayLike, threshold: float = 0.5, bridge: int = 6) -> list[Span]:
    """Find the spans of rows in which the object is present.

    Args:
        probability: Probability of presence, see `presence`. Shape (T,).
        threshold: Probability above which a row belongs to a span.
        bridge: Longest gap, in rows, that does not end a span.

    Raises:
        ValueError: Probabilities that are not finite, or of another shape.
    """
    given = as_numbers("probability", probability)
    if given.ndim != 1 or not is_within(given, LIMITS.scores):
        raise ValueError(f"probability must be finite with shape (T,), got shape {given.shape}; leave such rows out")
    above = np.flatnonzero(given > threshold)
    if not len(above):
        return []
    breaks = np.flatnonzero(np.diff(above) > bridge + 1)
    firsts = np.concatenate([above[:1], above[breaks + 1]])
    lasts = np.concatenate([above[breaks], above[-1:]])
    return [Span(int(first), int(last)) for first, last in zip(firsts, lasts, strict=True)]


@njit(cache=True, nogil=True)
def _two_states(ratio, switching, prior, out):  # type: ignore[no-untyped-def]
    """Forward-backward recursion over absent and present; `out` holds the forward probabilities in between."""
    T = ratio.shape[0]
    there = prior
    for k in range(T):
        if k > 0:
            there = there * (1.0 - switching) + (1.0 - there) * switching
        present = there * ratio[k]
        # A certain presence that the row excludes stays undecided by it.
        if present + 1.0 - there > 0.0:
            there = present / (present + 1.0 - there)
        out[k] = there
    # Backward messages of the two states, scaled to a sum of 1.
    absent_after, there_after = 0.5, 0.5
    for k in range(T - 1, -1, -1):
        if k < T - 1:
            absent, present = absent_after, there_after * ratio[k + 1]
            absent_after = (1.0 - switching) * absent + switching * present
            there_after = (1.0 - switching) * present + switching * absent
            total = absent_after + there_after
            absent_after, there_after = absent_after / total, there_after / total
        product = out[k] * there_after
        neither = product + (1.0 - out[k]) * absent_after
        if neither > 0.0:
            out[k] = product / neither
