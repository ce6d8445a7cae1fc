"""Scaled forward-backward smoothing of a chain, with the existence likelihood of each row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.hmm.chain import Chain, reach_of_band, step_band
from servotrack.estimators.types import Array, Labels

TINY = 1e-120
"""Offset added to messages, so that contradicting rows never leave all states with probability 0."""


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
            or a divisor of S, where state s has the likelihood of column s modulo W (a grid's positions).
        prior: Probabilities of the states at the first row; None: uniform. Shape (S,).
        presence: Probability that the chain's object exists in each row; the likelihood becomes 1 + presence (b - 1).
            None: always 1. Shape (T,).
        negligible: Probability, given the rows so far, below which the outermost of the W columns of states are omitted
            from a row. Columns within reach of the others are used again in the next row. Larger values limit the
            computation to the surroundings of a clear target. 0 omits none.

    Returns:
        Marginals, existence likelihoods (of the full likelihood) and evidence.

    Raises:
        ValueError: A shape is wrong, a likelihood is not positive and finite, or `negligible` is outside [0, 1e-6].
    """
    if not 0.0 <= negligible <= 1e-6:
        raise ValueError(f"negligible must lie in [0, 1e-6], got {negligible!r}")
    b = _checked(chain, likelihood)
    p = _prior(chain, prior)
    there = np.ones(len(b)) if presence is None else np.ascontiguousarray(presence, np.float64)
    if there.shape != (len(b),):
        raise ValueError(f"presence must have shape ({len(b)},), got {there.shape}")
    marginal = np.empty((len(b), chain.states))
    existence = np.empty(len(b))
    bands = np.empty((len(b), 2), np.int64)
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
    """
    b = _checked(chain, np.asarray(likelihood, np.float64)[None])[0]
    filtered = (_prior(chain, prior).reshape(-1, len(b)) * (1.0 + presence * (b - 1.0))).reshape(-1)
    predicted = chain.predict(filtered / filtered.sum())
    return predicted / predicted.sum()


def _checked(chain: Chain, likelihood: ArrayLike) -> Array:
    b = np.ascontiguousarray(likelihood, np.float64)
    if b.ndim != 2 or b.shape[1] == 0 or chain.states % b.shape[1]:
        raise ValueError(
            f"likelihood must have shape (rows, W) with W a divisor of {chain.states} states, got {b.shape}"
        )
    if b.size and not (b.min() > 0.0 and b.max() < np.inf):
        raise ValueError(f"likelihood must be positive and finite, got values from {b.min()!r} to {b.max()!r}")
    return b


def _prior(chain: Chain, prior: ArrayLike | None) -> Array:
    p = chain.uniform() if prior is None else np.ascontiguousarray(prior, np.float64)
    if p.shape != (chain.states,):
        raise ValueError(f"prior must have shape ({chain.states},), got {p.shape}")
    if not (np.isfinite(p).all() and p.min() >= 0.0 and p.sum() > 0.0):
        raise ValueError("prior must not be negative and must have a positive sum")
    return p / p.sum()


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
            b[i] = (1.0 + presence[k] * (likelihood[k, i] - 1.0)) / total
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
            b[i] = 1.0 + presence[k] * (likelihood[k, i] - 1.0)
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
