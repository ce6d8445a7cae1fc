"""Statistics against values known from elsewhere, and against what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.baselines.evaluation import statistics


def test_wilson_interval_agrees_with_the_published_formula() -> None:
    # 95 % interval of 9 out of 10, computed by hand from Wilson's formula with z = 1.959964.
    interval = statistics.wilson_interval(9, 10)
    z, p, n = 1.959963984540054, 0.9, 10
    center = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert interval.value == 0.9
    assert interval.low == pytest.approx(center - half, abs=1e-9)
    assert interval.high == pytest.approx(center + half, abs=1e-9)


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (20, 20)])
def test_wilson_interval_is_not_a_point_at_the_ends(successes: int, trials: int) -> None:
    interval = statistics.wilson_interval(successes, trials)
    assert interval.low <= interval.value <= interval.high
    assert interval.high - interval.low > 0.1


def test_worst_tenth_takes_the_bad_end_and_at_least_one() -> None:
    values = np.arange(1.0, 21.0)
    assert statistics.worst_tenth(values, high_is_bad=True) == 19.5
    assert statistics.worst_tenth(values, high_is_bad=False) == 1.5
    assert statistics.worst_tenth([3.0, 1.0], high_is_bad=True) == 3.0


def test_bootstrap_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = sum(
        low <= 1.0 <= high
        for _, low, high in (
            statistics.bootstrap_mean(rng.exponential(1.0, 80), confidence=0.9, resamples=400) for _ in range(300)
        )
    )
    # 270 on average for an exact interval; the percentile bootstrap of a skewed sample loses a little.
    assert covered > 245


def test_paired_difference_sees_what_an_unpaired_one_cannot() -> None:
    rng = np.random.default_rng(2)
    difficulty = rng.normal(0.0, 10.0, 60)
    better, worse = difficulty, difficulty + 0.5 + rng.normal(0.0, 0.2, 60)
    difference = statistics.paired_difference(better, worse)
    assert difference.high < 0.0
    assert difference.p_value < 0.01
    assert statistics.paired_difference(better, better).p_value == 1.0


def test_sign_flip_test_keeps_its_level_under_the_null() -> None:
    rng = np.random.default_rng(3)
    p_values = [
        statistics.paired_difference(rng.normal(size=12), rng.normal(size=12), resamples=300).p_value
        for _ in range(400)
    ]
    # At 5 %, 400 tests reject 20 times on average; 35 lies 3.4 standard deviations off.
    assert sum(p < 0.05 for p in p_values) < 35


def test_holm_on_a_textbook_example() -> None:
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.9, 0.8]) == [1.0, 1.0]
    assert statistics.holm([]) == []


def test_interquartile_mean_ignores_the_outer_quarters() -> None:
    assert statistics.interquartile_mean([-1e9, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e9]) == 3.5


def test_stratified_bootstrap_resamples_inside_each_task() -> None:
    # Two tasks without spread: resampling inside them cannot move the mean, resampling across them would.
    interval = statistics.stratified_interquartile_mean([np.zeros(10), np.ones(10)])
    assert interval == (0.5, 0.5, 0.5)


def test_score_puts_its_anchors_at_zero_and_one() -> None:
    rng = np.random.default_rng(4)
    random_error, oracle_error = rng.lognormal(-1.0, 0.5, 50), rng.lognormal(-6.0, 0.5, 50)
    assert statistics.score(random_error, random_error, oracle_error).mean() == pytest.approx(0.0, abs=1e-12)
    assert statistics.score(oracle_error, random_error, oracle_error).mean() == pytest.approx(1.0)
    halfway = np.sqrt(np.exp(np.log(random_error).mean() + np.log(oracle_error).mean()))
    assert statistics.score([halfway], random_error, oracle_error)[0] == pytest.approx(0.5)
    assert statistics.score([1e-9], random_error, oracle_error)[0] > 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: statistics.bootstrap_mean([]), "values must be a non-empty vector"),
        (lambda: statistics.bootstrap_mean([1.0, float("nan")]), "values must be finite, got nan"),
        (lambda: statistics.paired_difference([1.0], [1.0, 2.0]), "paired by seed, got 1 and 2"),
        (lambda: statistics.wilson_interval(3, 2), "got 3 of 2"),
        (lambda: statistics.score([0.0], [1.0], [0.1]), "error must be positive, got 0.0"),
        (lambda: statistics.score([0.5], [0.1], [0.1]), "must exceed"),
        (lambda: statistics.score([0.5], [0.1], [0.2]), "must exceed"),
        (lambda: statistics.stratified_interquartile_mean([]), "at least one task"),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()


def test_crossed_differences_count_the_spread_of_runs() -> None:
    rng = np.random.default_rng(0)
    reference = rng.normal(size=200)
    alike = reference + 1.0 + 0.01 * rng.normal(size=(10, 200))
    spread = alike + np.linspace(-2.0, 2.0, 10)[:, None]
    value, low, high = statistics.crossed_difference(alike, reference)
    assert low < value < high and abs(value - 1.0) < 0.01 and high - low < 0.01
    wide = statistics.crossed_difference(spread, reference)
    assert abs(wide.value - value) < 1e-9 and wide.high - wide.low > 1.0
    # Episodes alone would call this a sure win of 1.
    assert statistics.paired_difference(spread.mean(axis=0), reference).low > 0.9 > wide.low


def test_one_run_is_no_claim_about_training() -> None:
    with pytest.raises(ValueError, match="runs >= 2"):
        statistics.crossed_difference(np.ones((1, 3)), np.ones(3))
    with pytest.raises(ValueError, match="paired by seed"):
        statistics.crossed_difference(np.ones((2, 3)), np.ones(4))


def test_crossed_mean_is_wider_than_an_interval_over_episodes_alone_where_runs_differ() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(0.0, 1.0, (10, 1)) + rng.normal(0.0, 0.1, (10, 100))
    crossed, pooled = statistics.crossed_mean(values), statistics.bootstrap_mean(values.ravel())
    assert crossed.value == pytest.approx(values.mean())
    assert crossed.high - crossed.low > 3.0 * (pooled.high - pooled.low)


def test_crossed_mean_covers_the_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(200):
        values = 1.0 + rng.normal(0.0, 0.5, (10, 1)) + rng.normal(0.0, 0.5, 40) + rng.normal(0.0, 0.5, (10, 40))
        _, low, high = statistics.crossed_mean(values, confidence=0.9, resamples=400)
        covered += low <= 1.0 <= high
    # 180 for an exact interval; ten runs are few for a percentile bootstrap.
    assert covered > 165


def test_difference_of_methods_is_paired_by_episode() -> None:
    rng = np.random.default_rng(6)
    difficulty = rng.normal(0.0, 10.0, 60)
    a = difficulty + 0.5 + rng.normal(0.0, 0.2, (5, 60))
    b = difficulty + rng.normal(0.0, 0.2, (7, 60))
    difference = statistics.crossed_methods_difference(a, b)
    assert 0.4 < difference.low < difference.value < difference.high < 0.6
    with pytest.raises(ValueError, match="paired by seed"):
        statistics.crossed_methods_difference(a, b[:, 1:])
    with pytest.raises(ValueError, match=r"shape \(runs, episodes\)"):
        statistics.crossed_mean(np.zeros(3))


def test_probability_of_improvement_counts_pairs_and_halves_ties() -> None:
    found = statistics.probability_of_improvement([[1.0, 3.0], [5.0, 5.0]], [[2.0, 0.0], [5.0, 5.0]])
    # First task: 1 > 0, 3 > 2, 3 > 0 of four pairs; second task: only ties.
    assert found.value == pytest.approx((0.75 + 0.5) / 2)
    assert found.low <= found.value <= found.high
    with pytest.raises(ValueError, match="as many"):
        statistics.probability_of_improvement([[1.0]], [])


def test_performance_profile_falls_from_one_to_zero() -> None:
    profile = statistics.performance_profile([[0.0, 1.0], [[0.5, 0.5]]], [-1.0, 0.0, 0.5, 0.9, 1.0])
    assert profile.tolist() == [1.0, 0.75, 0.25, 0.25, 0.0]
    with pytest.raises(ValueError, match="at least one task"):
        statistics.performance_profile([], [0.0])
