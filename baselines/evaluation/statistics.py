"""Estimates with intervals: what the leaderboard says about a cell, a pair of agents, and a set of tasks.

Resampling uses a generator with a fixed seed of its own, so that the same rows always give the same intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from servotrack.estimators.types import Array

RESAMPLES = 2000
RESAMPLING_SEED = 0


class Interval(NamedTuple):
    """A point estimate with the ends of its interval."""

    value: float
    low: float
    high: float


class PairedDifference(NamedTuple):
    """Mean of paired differences, its bootstrap interval, and the p-value of a sign-flip permutation test."""

    value: float
    low: float
    high: float
    p_value: float


def _sample(values: ArrayLike, name: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name} must be a non-empty vector, got shape {array.shape}; give one number per episode")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {array[~np.isfinite(array)][0]}; drop or repair that episode")
    return array


def _percentiles(estimates: Array, value: float, confidence: float) -> Interval:
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(estimates, [tail, 100.0 - tail])
    return Interval(value, float(low), float(high))


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Success rate with Wilson's score interval (E. B. Wilson, 1927).

    Raises:
        ValueError: No trials, or successes outside 0..trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"successes must lie in 0..trials with trials >= 1, got {successes} of {trials}")
    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return Interval(successes / trials, float(interval.low), float(interval.high))


def worst_tenth(values: ArrayLike, *, high_is_bad: bool) -> float:
    """Mean of the worst tenth of the episodes (at least one), which an average over all of them hides."""
    ordered = np.sort(_sample(values, "values"))
    count = max(1, -(-ordered.size // 10))
    return float((ordered[-count:] if high_is_bad else ordered[:count]).mean())


def bootstrap_mean(values: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES) -> Interval:
    """Mean with a percentile bootstrap interval over episodes."""
    sample = _sample(values, "values")
    rng = np.random.default_rng(RESAMPLING_SEED)
    indices = rng.integers(sample.size, size=(resamples, sample.size))
    return _percentiles(sample[indices].mean(axis=1), float(sample.mean()), confidence)


def paired_difference(
    values: ArrayLike, reference: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES
) -> PairedDifference:
    """Mean of `values - reference`, paired by seed.

    Args:
        values: One number per episode. Shape (k,).
        reference: The reference agent's numbers on the same seeds in the same order. Shape (k,).
        confidence: Confidence of the percentile bootstrap interval.
        resamples: Number of resamples of the bootstrap and of the permutation test.

    Returns:
        The mean difference, its interval, and the two-sided p-value of the sign-flip test for a mean of zero.

    Raises:
        ValueError: Different lengths, empty or not finite.
    """
    a, b = _sample(values, "values"), _sample(reference, "reference")
    if a.shape != b.shape:
        raise ValueError(f"values and reference must be paired by seed, got {a.size} and {b.size} episodes")
    difference = a - b
    value, low, high = bootstrap_mean(difference, confidence, resamples)
    signs = np.random.default_rng(RESAMPLING_SEED).choice([-1.0, 1.0], size=(resamples, difference.size))
    flipped = np.abs((signs * difference).mean(axis=1))
    as_extreme = np.count_nonzero(flipped >= abs(value) * (1.0 - 1e-12))
    return PairedDifference(value, low, high, (1 + as_extreme) / (1 + resamples))


def crossed_difference(
    values: ArrayLike, reference: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES
) -> Interval:
    """Mean of `values - reference` over training runs and episodes; the bootstrap resamples both, crossed.

    An interval over episodes alone says what these trained agents do; this one says what training gives.

    Args:
        values: One number per training run and episode. Shape (runs, k).
        reference: The reference agent's numbers on the same seeds in the same order. Shape (k,).
        confidence: Confidence of the percentile interval.
        resamples: Number of bootstrap resamples.

    Raises:
        ValueError: Fewer than two runs, different lengths, empty or not finite.
    """
    runs, b = np.asarray(values, dtype=np.float64), _sample(reference, "reference")
    if runs.ndim != 2 or len(runs) < 2 or runs.shape[1:] != b.shape:
        raise ValueError(f"values must have shape (runs >= 2, {b.size}), paired by seed, got {runs.shape}")
    difference = np.array([_sample(run, "values") for run in runs]) - b
    rng = np.random.default_rng(RESAMPLING_SEED)
    chosen_runs = rng.integers(len(runs), size=(resamples, len(runs)))
    chosen_episodes = rng.integers(b.size, size=(resamples, b.size))
    means = np.array([difference[r][:, e].mean() for r, e in zip(chosen_runs, chosen_episodes, strict=True)])
    return _percentiles(means, float(difference.mean()), confidence)


def _runs(values: ArrayLike, name: str) -> Array:
    runs = np.asarray(values, dtype=np.float64)
    if runs.ndim != 2 or runs.size == 0 or not np.isfinite(runs).all():
        raise ValueError(
            f"{name} must have shape (runs, episodes), not empty and finite, got {runs.shape}; give one row per run"
        )
    return runs


def _drawn_runs(count: int, resamples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Share of each run in each resample, shape (resamples, count)."""
    return rng.multinomial(count, np.full(count, 1.0 / count), size=resamples) / count


def crossed_mean(values: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES) -> Interval:
    """Mean over training runs and episodes; the bootstrap resamples both, crossed.

    Args:
        values: One number per training run and episode. Shape (runs, k). With one run only episodes are resampled.
        confidence: Confidence of the percentile interval.
        resamples: Number of bootstrap resamples.

    Raises:
        ValueError: Another shape, empty or not finite.
    """
    runs = _runs(values, "values")
    rng = np.random.default_rng(RESAMPLING_SEED)
    weights = _drawn_runs(len(runs), resamples, rng)
    episodes = _drawn_runs(runs.shape[1], resamples, rng)
    means = ((weights @ runs) * episodes).sum(axis=1)
    return _percentiles(means, float(runs.mean()), confidence)


def crossed_methods_difference(
    values: ArrayLike, reference: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES
) -> Interval:
    """Mean of one method minus that of another, both over training runs and episodes; both are resampled, crossed.

    Runs are resampled for each method by itself, episodes for both together, because they are the same seeds.

    Args:
        values: One number per run and episode. Shape (runs, k).
        reference: The same of the other method, with any number of runs. Shape (other runs, k).
        confidence: Confidence of the percentile interval.
        resamples: Number of bootstrap resamples.

    Raises:
        ValueError: Other shapes, empty or not finite.
    """
    a, b = _runs(values, "values"), _runs(reference, "reference")
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"values and reference must be paired by seed, got {a.shape[1]} and {b.shape[1]} episodes")
    rng = np.random.default_rng(RESAMPLING_SEED)
    means = _drawn_runs(len(a), resamples, rng) @ a - _drawn_runs(len(b), resamples, rng) @ b
    episodes = _drawn_runs(a.shape[1], resamples, rng)
    return _percentiles((means * episodes).sum(axis=1), float(a.mean() - b.mean()), confidence)


def probability_of_improvement(
    tasks: Sequence[ArrayLike], references: Sequence[ArrayLike], confidence: float = 0.95, resamples: int = RESAMPLES
) -> Interval:
    """Probability that a run of one method beats a run of another, mean over tasks; ties count one half.

    Source: R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021. The
    bootstrap resamples the runs of each method inside each task.

    Args:
        tasks: Scores of the runs, one array per task; larger is better.
        references: The same of the other method, for the same tasks.
        confidence: Confidence of the percentile interval.
        resamples: Number of bootstrap resamples.

    Raises:
        ValueError: No tasks, different numbers of tasks, or scores that are not finite.
    """
    if not tasks or len(tasks) != len(references):
        raise ValueError(f"tasks and references must be as many, at least one, got {len(tasks)} and {len(references)}")
    rng, value, estimates = np.random.default_rng(RESAMPLING_SEED), 0.0, np.zeros(resamples)
    for i, (task, reference) in enumerate(zip(tasks, references, strict=True)):
        a, b = _sample(task, f"tasks[{i}]"), _sample(reference, f"references[{i}]")
        wins = (a[:, None] > b).astype(np.float64) + 0.5 * (a[:, None] == b)
        weights = _drawn_runs(len(a), resamples, rng)[:, None] @ wins @ _drawn_runs(len(b), resamples, rng)[..., None]
        value, estimates = value + float(wins.mean()), estimates + weights[:, 0, 0]
    return _percentiles(estimates / len(tasks), value / len(tasks), confidence)


def performance_profile(tasks: Sequence[ArrayLike], thresholds: ArrayLike) -> Array:
    """Share of runs and episodes whose score is above each threshold, mean over tasks.

    Source: E. Dolan and J. More, Benchmarking optimization software with performance profiles, 2002; for scores as in
    R. Agarwal et al., NeurIPS 2021.

    Args:
        tasks: Scores of each task, of any shape.
        thresholds: Ascending thresholds. Shape (t,).

    Returns:
        Shares in [0, 1]. Shape (t,).

    Raises:
        ValueError: No tasks, or scores that are not finite.
    """
    if not tasks:
        raise ValueError("tasks must hold at least one task, got none")
    levels = _sample(thresholds, "thresholds")
    samples = [np.sort(_sample(np.ravel(task), f"tasks[{i}]")) for i, task in enumerate(tasks)]
    above = [1.0 - np.searchsorted(sample, levels, side="right") / sample.size for sample in samples]
    return np.mean(above, axis=0)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for several comparisons by Holm's step-down method (S. Holm, 1979), in the order given."""
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)))
    return adjusted.tolist()


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half of the values."""
    return float(stats.trim_mean(_sample(np.ravel(values), "values"), 0.25))


def stratified_interquartile_mean(
    tasks: Sequence[ArrayLike], confidence: float = 0.95, resamples: int = RESAMPLES
) -> Interval:
    """Interquartile mean over all episodes of several tasks; the bootstrap resamples episodes inside each task.

    Source: R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021.

    Args:
        tasks: Scores of the episodes, one array per task.
        confidence: Confidence of the percentile interval.
        resamples: Number of bootstrap resamples.
    """
    samples = [_sample(task, f"tasks[{i}]") for i, task in enumerate(tasks)]
    if not samples:
        raise ValueError("tasks must hold at least one task, got none")
    rng = np.random.default_rng(RESAMPLING_SEED)
    drawn = [sample[rng.integers(sample.size, size=(resamples, sample.size))] for sample in samples]
    estimates = stats.trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
    return _percentiles(np.asarray(estimates), interquartile_mean(np.concatenate(samples)), confidence)


def score(error: ArrayLike, random_error: ArrayLike, oracle_error: ArrayLike) -> Array:
    """Skill of each episode between two anchors: ln(e_random / e) / ln(e_random / e_oracle), unclipped.

    The anchors' errors are the geometric means of their episodes, so that the anchors' own mean scores are exactly 0
    and 1. The oracle is no upper bound: an agent with a model may exceed 1.

    Args:
        error: Steady error of each episode of the agent. Shape (k,), m.
        random_error: The same for the agent without skill. Shape (r,), m.
        oracle_error: The same for the agent with the analytic Jacobian. Shape (o,), m.

    Returns:
        Shape (k,).

    Raises:
        ValueError: An error that is not positive and finite, or an agent without skill that is not worse.
    """
    logs = []
    for name, values in (("error", error), ("random_error", random_error), ("oracle_error", oracle_error)):
        sample = _sample(values, name)
        if (sample <= 0.0).any():
            raise ValueError(f"{name} must be positive, got {sample.min()}; a tracking error of zero has no logarithm")
        logs.append(np.log(sample))
    log_error, log_random, log_oracle = logs[0], logs[1].mean(), logs[2].mean()
    if log_random <= log_oracle or np.isclose(log_random, log_oracle):
        raise ValueError(
            f"random_error must exceed oracle_error, got geometric means of {np.exp(log_random):.6g} and "
            f"{np.exp(log_oracle):.6g} m; the task does not separate skill"
        )
    return (log_random - log_error) / (log_random - log_oracle)
