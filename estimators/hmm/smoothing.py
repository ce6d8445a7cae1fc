"""Scaled forward-backward smoothing of a chain, with what each row says about the chain's existence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.hmm.chain import Chain, predict_into, retrodict_into

Array = NDArray[np.float64]


TINY = 1e-120
"""Added to messages: rows that contradict each other must not leave all states with a probability of 0."""


class Smoothed(NamedTuple):
    """What all rows together say.

    Attributes:
        marginal: Probability of each state in each row given all rows. Shape (T, S).
        existence_likelihood: Lam_k: mean likelihood of row k under what all other rows say of the state; its mean is 1
            where the rows are noise. Shape (T,).
        log_evidence: Sum of the logarithms of the scales c_k: of the likelihood of all rows.
    """

    marginal: Array
    existence_likelihood: Array
    log_evidence: float


def smooth(
    chain: Chain, likelihood: ArrayLike, prior: ArrayLike | None = None, presence: ArrayLike | None = None
) -> Smoothed:
    """Forward-backward (paper 003, eqs. 8 to 16 and the appendix, reconstructed).

    Args:
        chain: S states.
        likelihood: Ratio of each row's likelihood under the state to that under noise, positive. Shape (T, W): W = S,
            or a divisor of S where the state s has the likelihood s modulo W (a grid's positions).
        prior: Probabilities of the states at the first row; None: uniform. Shape (S,).
        presence: Probability that the chain's object is there in each row: rows count as 1 + presence (b - 1). None:
            always. Shape (T,).

    Returns:
        Marginals, existence likelihoods (of the full likelihood) and evidence.

    Raises:
        ValueError: For a wrong shape, or likelihoods that are not positive and finite.
    """
    b = _checked(chain, likelihood)
    p = _prior(chain, prior)
    there = np.ones(len(b)) if presence is None else np.ascontiguousarray(presence, np.float64)
    if there.shape != (len(b),):
        raise ValueError(f"presence must have shape ({len(b)},), got {there.shape}")
    marginal = np.empty((len(b), chain.states))
    existence = np.empty(len(b))
    evidence = _forward_backward(chain.runs, b, p, there, marginal, existence)
    return Smoothed(marginal, existence, float(evidence))


def advance(chain: Chain, prior: ArrayLike, likelihood: ArrayLike, presence: float = 1.0) -> Array:
    """Prior of the next row: one forward step.

    Args:
        chain: S states.
        prior: Probabilities before the row. Shape (S,).
        likelihood: Of the row, as in `smooth`. Shape (W,).
        presence: As in `smooth`.

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
def _forward_backward(runs, likelihood, prior, presence, marginal, existence):  # type: ignore[no-untyped-def]
    """Writes the marginals over the forward messages; returns the log evidence."""
    T, W = likelihood.shape
    S = prior.shape[0]
    message = prior.copy()
    b = np.empty(W)
    evidence = 0.0
    for k in range(T):
        if k > 0:
            predict_into(runs, marginal[k - 1], message)
        for i in range(W):
            b[i] = 1.0 + presence[k] * (likelihood[k, i] - 1.0)
        alpha = marginal[k]
        total = 0.0
        for start in range(0, S, W):
            total += _multiply(message[start : start + W], b, alpha[start : start + W])
        evidence += np.log(total)
        alpha *= 1.0 / total
    beta = np.ones(S)
    weighted = np.empty(S)
    cavity = np.empty(W)
    for k in range(T - 1, -1, -1):
        for i in range(W):
            b[i] = 1.0 + presence[k] * (likelihood[k, i] - 1.0)
        gamma = marginal[k]
        cavity[:] = 0.0
        for start in range(0, S, W):
            _accumulate(gamma[start : start + W], beta[start : start + W], cavity)
        total, without, with_row = 0.0, 0.0, 0.0
        for i in range(W):
            total += cavity[i]
            without += cavity[i] / b[i]
            with_row += cavity[i] / b[i] * likelihood[k, i]
        existence[k] = with_row / without
        gamma *= 1.0 / total
        if k > 0:
            for start in range(0, S, W):
                _multiply(beta[start : start + W], b, weighted[start : start + W])
            weighted *= 1.0 / weighted.sum()
            retrodict_into(runs, weighted, beta)
            beta *= 1.0 / beta.max()
            beta += TINY
    return evidence


@njit(cache=True, nogil=True, fastmath=True)
def _multiply(values, factors, out):  # type: ignore[no-untyped-def]
    """Products into out, of values that are at least TINY; returns their sum."""
    total = 0.0
    for i in range(out.shape[0]):
        out[i] = (values[i] + TINY) * factors[i]
        total += out[i]
    return total


@njit(cache=True, nogil=True)
def _accumulate(gamma, beta, cavity):  # type: ignore[no-untyped-def]
    """The message gamma becomes gamma times beta, and is added to the cavity."""
    for i in range(gamma.shape[0]):
        gamma[i] *= beta[i]
        cavity[i] += gamma[i]
