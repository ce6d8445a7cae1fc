"""Scaled forward-backward smoothing of a chain, with the existence likelihood of each row."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.hmm.chain import Chain, reach_of_band, step_band
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import as_numbers, first_bad

TINY = 1e-120
"""Offset added to messages, so that contradicting rows never leave all states with probability 0."""
EXTREME = 1e60
"""Likelihoods beyond this, or below its inverse, are multiplied in logarithms."""
CANCELED = 1e-3
"""Value of 1 + presence (b - 1) below which the difference loses digits, and the sum of both parts is taken."""


class Smoothed(NamedTuple):
    """Result of `smooth`.

    Attributes:
        marginal: Probability of each state in each row given all rows. Shape (T, S).
        existence_likelihood: Lam_k, the mean likelihood of row k under the state distribution given all other rows. Its
            mean is 1 where the rows are noise. Shape (T,).
        log_evidence: Log likelihood of all rows, the sum of the logarithms of the scales c_k.
        bands: First of the W columns used in each row, and the column after the last one. Shape (T, 2).
    """

    marginal: Array
    existence_likelihood: Array
    log_evidence: float
    bands: Labels


def smooth(
    chain: Chain,
    likelihood: ArrayLike,
    prior: ArrayLike | None = None,
    presence: ArrayLike | None = None,
    negligible: float = 0.0,
) -> Smoothed:
    """Forward-backward smoothing (Jiang and Zhou 2016, eqs. 8 to 16 and the appendix, reconstructed).

    Args:
        chain: Markov chain of S states.
        likelihood: Ratio b of each row's likelihood under the state to that under noise, positive. Shape (T, W): W = S,
            or a divisor of S, where state s has the likelihood of column s modulo W (a grid's positions). Any positive
            float64 is accepted.
        prior: Probabilities of the states at the first row; None: uniform. Shape (S,).
        presence: Probability that the chain's object exists in each row; the likelihood becomes (1 - presence) +
            presence b. None: always 1. Shape (T,).
        negligible: Probability, given the rows so far, below which the outermost of the W columns of states are omitted
            from a row. Columns within reach of the others are used again in the next row. Larger values limit the
            computation to the surroundings of a clear target. 0 omits none.

    Returns:
        Marginals, existence likelihoods (of the full likelihood) and evidence.

    Raises:
        ValueError: A shape is wrong, a likelihood is not positive and finite, or a probability is out of range.
    """
    if not 0.0 <= negligible <= 1e-6:
        raise ValueError(f"negligible must lie in [0, 1e-6], got {negligible!r}")
    b = _checked(chain, likelihood)
    p = _prior(chain, prior)
    there = np.ones(len(b)) if presence is None else as_numbers("presence", presence)
    if there.shape != (len(b),):
        raise ValueError(f"presence must have shape ({len(b)},), one probability per row, got {there.shape}")
    _check_probabilities("presence", there)
    marginal = np.empty((len(b), chain.states))
    existence = np.empty(len(b))
    bands = np.empty((len(b), 2), np.int64)
    if _is_extreme(b):
        bands[:] = 0, b.shape[1]
        evidence = _forward_backward_in_logarithms(chain.runs, b, p, there, marginal, existence)
    else:
        evidence = _forward_backward(chain.runs, b, p, there, negligible, marginal, existence, bands)
    return Smoothed(marginal, existence, float(evidence), bands)


def advance(chain: Chain, prior: ArrayLike, likelihood: ArrayLike, presence: float = 1.0) -> Array:
    """Compute the prior of the next row by one forward step.

    Args:
        chain: Markov chain of S states.
        prior: Probabilities before the row. Shape (S,).
        likelihood: Likelihood ratios of the row, see `smooth`. Shape (W,).
        presence: Probability that the object exists in the row.

    Returns:
        Probabilities before the next row, normalized. Shape (S,).

    Raises:
        ValueError: As `smooth` does, or if all probability leaves the grid.
    """
    _check_probabilities("presence", np.asarray(presence, np.float64))
    b = _checked(chain, as_numbers("likelihood", likelihood)[None])[0]
    mixed = _mixed_rows(b, float(presence))
    p = _prior(chain, prior).reshape(-1, len(b))
    if _is_extreme(b):
        # Relative to the largest product, so that nothing overflows and the largest one stays.
        with np.errstate(divide="ignore"):
            logarithm = np.log(p) + np.log(mixed)
        filtered = np.exp(logarithm - logarithm.max()).reshape(-1)
    else:
        filtered = (p * mixed).reshape(-1)
    predicted = chain.predict(filtered / filtered.sum())
    total = predicted.sum()
    if not total > 0.0:
        raise ValueError(
            "prior and likelihood must leave some probability on the grid, got 0 after one step; widen the grid"
        )
    return predicted / total


def _checked(chain: Chain, likelihood: ArrayLike) -> Array:
    b = as_numbers("likelihood", likelihood)
    if b.ndim != 2 or b.shape[1] == 0 or chain.states % b.shape[1]:
        raise ValueError(
            f"likelihood must have shape (rows, W) with W a divisor of {chain.states} states, got {b.shape}"
        )
    if b.size and not (b.min() > 0.0 and b.max() < np.inf):
        raise ValueError(f"likelihood must be positive and finite, got values from {b.min()!r} to {b.max()!r}")
    return b


def _prior(chain: Chain, prior: ArrayLike | None) -> Array:
    p = chain.uniform() if prior is None else as_numbers("prior", prior)
    if p.shape != (chain.states,):
        raise ValueError(f"prior must have shape ({chain.states},), got {p.shape}")
    total = p.sum()
    if not (p.min() >= 0.0 and 0.0 < total < np.inf):
        raise ValueError(
            f"prior must be finite and not negative with a positive sum, got values from {p.min()!r} to {p.max()!r}; "
            "pass probabilities"
        )
    return p / total


def _check_probabilities(name: str, values: Array) -> None:
    bad = ~((values >= 0.0) & (values <= 1.0))
    if bad.any():
        raise ValueError(f"{name} must be probabilities from 0 to 1, got {first_bad(values, bad)}; clip them first")


def _is_extreme(likelihood: Array) -> bool:
    return likelihood.size > 0 and not (likelihood.min() >= 1.0 / EXTREME and likelihood.max() <= EXTREME)


@njit(cache=True, nogil=True)
def mixed_with_absence(likelihood, presence):  # type: ignore[no-untyped-def]
    """Likelihood ratio (1 - presence) + presence b of a row whose object may be absent."""
    mixed = 1.0 + presence * (likelihood - 1.0)
    return mixed if mixed > CANCELED else (1.0 - presence) + presence * likelihood


@njit(cache=True, nogil=True)
def _mixed_rows(likelihood, presence):  # type: ignore[no-untyped-def]
    out = np.empty(likelihood.shape[0])
    for i in range(out.shape[0]):
        out[i] = mixed_with_absence(likelihood[i], presence)
    return out


@njit(cache=True, nogil=True)
def _forward_backward_in_logarithms(runs, likelihood, prior, presence, marginal, existence):  # type: ignore[no-untyped-def]
    """Compute `_forward_backward` for likelihoods of any size: all products are sums of logarithms.

    `marginal` holds the logarithms of the predicted messages in between.
    """
    T, W = likelihood.shape
    S = prior.shape[0]
    message, moved, filtered = np.empty(S), np.empty(S), np.empty(S)
    evidence = 0.0
    for k in range(T):
        if k == 0:
            moved[:] = prior
        else:
            for s in range(S):
                message[s] = math.exp(filtered[s])
            moved[:] = 0.0
            step_band(runs, runs.source, runs.target, message, W, 0, W, moved)
        for s in range(S):
            marginal[k, s] = math.log(moved[s] + TINY)
            filtered[s] = marginal[k, s] + math.log(mixed_with_absence(likelihood[k, s % W], presence[k]))
        total = _log_sum(filtered)
        evidence += total
        for s in range(S):
            filtered[s] -= total
    after = np.zeros(S)
    for k in range(T - 1, -1, -1):
        for s in range(S):
            message[s] = marginal[k, s] + after[s]
        without = _log_sum(message)
        for s in range(S):
            filtered[s] = message[s] + math.log(likelihood[k, s % W])
        largest = likelihood[k].max()
        existence[k] = min(math.exp(min(_log_sum(filtered) - without, math.log(largest))), largest)
        for s in range(S):
            b = math.log(mixed_with_absence(likelihood[k, s % W], presence[k]))
            message[s] += b
            after[s] += b
        total = _log_sum(message)
        for s in range(S):
            marginal[k, s] = math.exp(message[s] - total)
        if k > 0:
            top = after.max()
            for s in range(S):
                message[s] = math.exp(after[s] - top)
            moved[:] = 0.0
            step_band(runs, runs.target, runs.source, message, W, 0, W, moved)
            top = moved.max()
            for s in range(S):
                after[s] = math.log(moved[s] / top + TINY) if top > 0.0 else 0.0
    return evidence


@njit(cache=True, nogil=True)
def _log_sum(values):  # type: ignore[no-untyped-def]
    """Logarithm of the sum of exponentials."""
    top = values.max()
    total = 0.0
    for i in range(values.shape[0]):
        total += math.exp(values[i] - top)
    return top + math.log(total)


@njit(cache=True, nogil=True)
def _forward_backward(runs, likelihood, prior, presence, negligible, marginal, existence, bands):  # type: ignore[no-untyped-def]
    """Overwrite the forward messages with the marginals and return the log evidence."""
    T, W = likelihood.shape
    S = prior.shape[0]
    message = prior.copy()
    b, cavity = np.empty(W), np.empty(W)
    evidence, total = 0.0, 1.0
    low, high = 0, W
    for k in range(T):
        if k > 0:
            before = low, high
            low, high = reach_of_band(runs, W, low, high)
            for start in range(0, S, W):
                message[start + low : start + high] = 0.0
            step_band(runs, runs.source, runs.target, marginal[k - 1], W, before[0], before[1], message)
        # The messages are not normalized: the sum of one is taken out of the next one's likelihood.
        for i in range(low, high):
            b[i] = mixed_with_absence(likelihood[k, i], presence[k]) / total
        alpha = marginal[k]
        cavity[low:high] = 0.0
        for start in range(0, S, W):
            span = slice(start + low, start + high)
            _multiply(message[span], b[low:high], alpha[span], cavity[low:high])
        total = cavity[low:high].sum()
        evidence += np.log(total)
        while high - low > 1 and cavity[low] < negligible * total:
            low += 1
        while high - low > 1 and cavity[high - 1] < negligible * total:
            high -= 1
        bands[k] = low, high
    beta, weighted = np.ones(S), np.zeros(S)
    for k in range(T - 1, -1, -1):
        low, high = bands[k]
        for i in range(low, high):
            b[i] = mixed_with_absence(likelihood[k, i], presence[k])
        gamma = marginal[k]
        cavity[low:high] = 0.0
        for start in range(0, S, W):
            span = slice(start + low, start + high)
            _accumulate(gamma[span], beta[span], cavity[low:high])
        total, without, with_row = 0.0, 0.0, 0.0
        for i in range(low, high):
            total += cavity[i]
            without += cavity[i] / b[i]
            with_row += cavity[i] / b[i] * likelihood[k, i]
        existence[k] = with_row / without
        for start in range(0, S, W):
            gamma[start : start + low] = 0.0
            gamma[start + low : start + high] *= 1.0 / total
            gamma[start + high : start + W] = 0.0
        if k > 0:
            for start in range(0, S, W):
                weighted[start : start + W] = 0.0
                weighted[start + low : start + high] = beta[start + low : start + high] * b[low:high]
            low, high = bands[k - 1]
            for start in range(0, S, W):
                beta[start + low : start + high] = 0.0
            step_band(runs, runs.target, runs.source, weighted, W, low, high, beta)
            largest = 0.0
            for start in range(0, S, W):
                largest = max(largest, beta[start + low : start + high].max())
            for start in range(0, S, W):
                _rescale(beta[start + low : start + high], 1.0 / largest)
    return evidence


@njit(cache=True, nogil=True)
def _multiply(values, factors, out, cavity):  # type: ignore[no-untyped-def]
    """Write the products of values + TINY and factors to `out`, and add them to the cavity."""
    for i in range(out.shape[0]):
        out[i] = (values[i] + TINY) * factors[i]
    for i in range(out.shape[0]):
        cavity[i] += out[i]


@njit(cache=True, nogil=True)
def _accumulate(gamma, beta, cavity):  # type: ignore[no-untyped-def]
    """Multiply gamma by beta in place, and add the product to the cavity."""
    for i in range(gamma.shape[0]):
        gamma[i] *= beta[i]
    for i in range(gamma.shape[0]):
        cavity[i] += gamma[i]


@njit(cache=True, nogil=True)
def _rescale(beta, factor):  # type: ignore[no-untyped-def]
    for i in range(beta.shape[0]):
        beta[i] = beta[i] * factor + TINY
