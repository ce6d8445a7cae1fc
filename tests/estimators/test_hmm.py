"""Chains over grids: exact on small cases, probabilities that sum to one, and errors that say what fits."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.hmm import (
    Span,
    advance,
    best_path,
    exclude,
    grid_chain,
    occupancy,
    presence,
    smooth,
    spans,
    sparse_chain,
)


def small_chain(seed, states=4):
    rng = np.random.default_rng(seed)
    transitions = rng.random((states, states)) + 0.01
    transitions /= transitions.sum(axis=1, keepdims=True)
    return transitions, rng.random((4, states)) + 0.1


def enumerated(transitions, rows):
    """(path, prior times transitions, likelihoods of its rows) of all paths."""
    T, S = rows.shape
    for path in itertools.product(range(S), repeat=T):
        weight = np.prod([transitions[a, b] for a, b in itertools.pairwise(path)]) / S
        yield np.array(path), weight, rows[np.arange(T), list(path)]


@pytest.mark.parametrize("seed", range(3))
def test_smoothing_is_exact(seed):
    transitions, rows = small_chain(seed)
    marginal, with_row, without_row = np.zeros(rows.shape), 0.0, np.zeros(len(rows))
    for path, weight, likelihood in enumerated(transitions, rows):
        joint = weight * likelihood.prod()
        marginal[np.arange(len(rows)), path] += joint
        with_row += joint
        without_row += joint / likelihood
    found = smooth(sparse_chain(transitions), rows)
    np.testing.assert_allclose(found.marginal, marginal / with_row, rtol=1e-10)
    np.testing.assert_allclose(found.existence_likelihood, with_row / without_row, rtol=1e-10)
    assert found.log_evidence == pytest.approx(np.log(with_row))


@pytest.mark.parametrize("seed", range(3))
def test_best_path_is_the_best_of_all(seed):
    transitions, rows = small_chain(seed)
    best = max(enumerated(transitions, rows), key=lambda item: item[1] * item[2].prod())
    path, value = best_path(sparse_chain(transitions), np.log(rows))
    assert path.tolist() == best[0].tolist()
    assert value == pytest.approx(np.log(best[1] * rows.shape[1] * best[2].prod()))


def test_presence_is_exact():
    ratio = np.array([0.3, 2.0, 5.0, 0.5])
    weights = np.zeros((2, 4))
    for states in itertools.product((0, 1), repeat=4):
        weight = 0.5 * np.prod([0.9 if a == b else 0.1 for a, b in itertools.pairwise(states)])
        weight *= np.prod([r if d else 1.0 for d, r in zip(states, ratio, strict=True)])
        for k, d in enumerate(states):
            weights[d, k] += weight
    np.testing.assert_allclose(presence(ratio, switching=0.1), weights[1] / weights.sum(axis=0), rtol=1e-12)


@given(seed=st.integers(0, 10_000), strength=st.floats(0.0, 15.0))
@settings(max_examples=30, deadline=None)
def test_probabilities_sum_to_one(seed, strength):
    rng = np.random.default_rng(seed)
    chain = grid_chain(41, [-1.0, -0.5, 0.0, 0.5, 1.0], 0.25)
    rows = np.exp(strength * rng.normal(size=(12, 41)))
    found = smooth(chain, rows, presence=rng.random(12))
    np.testing.assert_allclose(found.marginal.sum(axis=1), 1.0, rtol=1e-9)
    there = presence(found.existence_likelihood)
    assert np.isfinite(found.marginal).all() and (there >= 0.0).all() and (there <= 1.0).all()


def test_negligible_surroundings_are_left_out_and_change_nothing():
    chain = grid_chain(201, [-1.0, -0.5, 0.0, 0.5, 1.0], 0.25)
    at = 80 + np.arange(20)
    rows = np.exp(np.maximum(12.0 - 0.5 * (np.arange(201) - at[:, None]) ** 2, -4.0))
    there = np.r_[np.full(15, 1.0), np.full(5, 0.05)]
    whole, part = (smooth(chain, rows, presence=there, negligible=least) for least in (0.0, 1e-25))
    np.testing.assert_allclose(part.marginal, whole.marginal, atol=1e-20)
    np.testing.assert_allclose(part.existence_likelihood, whole.existence_likelihood, rtol=1e-12)
    assert part.log_evidence == pytest.approx(whole.log_evidence, rel=1e-12)
    assert (whole.bands == [0, 201]).all()
    width = np.diff(part.bands, axis=1)[:, 0]
    assert width[10:15].max() < 100 and width[19] > width[14]
    outside = np.ones((20, 201), np.bool_)
    for row, (first, stop) in zip(outside, part.bands, strict=True):
        row[first:stop] = False
    assert (part.marginal.reshape(20, 5, 201).sum(axis=1)[outside] == 0.0).all()


def test_existence_likelihood_has_mean_one_under_noise():
    rng = np.random.default_rng(4)
    chain = grid_chain(81, [-0.5, 0.0, 0.5], 0.25)
    amplitude = 1.0
    values = [
        smooth(chain, np.exp(amplitude * rng.normal(size=(20, 81)) - amplitude**2 / 2.0)).existence_likelihood
        for _ in range(400)
    ]
    mean, error = np.mean(values), np.std(values) / np.sqrt(np.size(values))
    assert error < 0.02
    assert abs(mean - 1.0) < 4.0 * error


def test_a_mirrored_record_gives_mirrored_marginals():
    rng = np.random.default_rng(5)
    chain = grid_chain(61, [-1.0, -0.5, 0.0, 0.5, 1.0], 0.25)
    rows = np.exp(rng.normal(size=(15, 61)))
    straight = smooth(chain, rows).marginal.reshape(15, 5, 61)
    mirrored = smooth(chain, rows[:, ::-1]).marginal.reshape(15, 5, 61)
    np.testing.assert_allclose(mirrored, straight[:, ::-1, ::-1], rtol=1e-9, atol=1e-12)


def test_a_grid_chain_moves_by_the_mean_of_both_rates():
    chain = grid_chain(21, [-0.5, 0.0, 0.5], 0.25, acceleration=0.3)
    start = np.zeros((3, 21))
    start[2, 10] = 1.0
    after = chain.predict(start.ravel()).reshape(3, 21)
    assert {(int(r), int(i)) for r, i in np.argwhere(after)} == {(2, 12), (1, 11), (0, 10)}
    weights = np.exp(-(np.array([1.0, 0.5, 0.0]) ** 2) / (2 * 0.3**2))
    np.testing.assert_allclose([after[0, 10], after[1, 11], after[2, 12]], weights / weights.sum(), rtol=1e-12)


def test_advance_continues_where_a_shorter_record_ended():
    rng = np.random.default_rng(6)
    chain = grid_chain(41, [-0.5, 0.0, 0.5], 0.25)
    rows = np.exp(rng.normal(size=(6, 41)))
    prior = advance(chain, chain.uniform(), rows[0])
    np.testing.assert_allclose(smooth(chain, rows[1:], prior).marginal, smooth(chain, rows).marginal[1:], rtol=1e-6)


def test_what_others_hold_says_nothing():
    chain = grid_chain(41, [-0.5, 0.0, 0.5], 0.25)
    rows = np.full((3, 41), 0.5)
    rows[:, 20] = 50.0
    other = smooth(chain, rows**5).marginal
    held = occupancy(other, np.ones(3), 41, spread=2)
    free = exclude(rows, [held]).reshape(3, 3, 41)
    assert held.max() <= 1.0
    np.testing.assert_allclose(free[1, 1, 20], 1.0, atol=0.1)
    np.testing.assert_allclose(free[:, :, 0], rows[:, None, 0].repeat(3, axis=1), rtol=1e-6)
    np.testing.assert_allclose(exclude(rows, [held * 0.0]).reshape(3, 3, 41)[:, 0], rows)


def test_gaps_up_to_the_bridge_do_not_end_a_span():
    probability = np.array([0.1, 0.9, 0.9, 0.1, 0.1, 0.9, 0.1, 0.1, 0.1, 0.8])
    assert spans(probability, bridge=2) == [Span(1, 5), Span(9, 9)]
    assert spans(probability, bridge=3) == [Span(1, 9)]
    assert spans(np.zeros(4)) == []


def test_rates_that_do_not_fit_name_the_spacing_that_does():
    with pytest.raises(ValueError, match=r"spacing=0\.25"):
        grid_chain(361, np.arange(-2.0, 2.1, 0.5), 0.5)
    grid_chain(721, np.arange(-2.0, 2.1, 0.5), 0.25)
    with pytest.raises(ValueError, match=r"spacing=0\.15"):
        grid_chain(721, [-0.3, 0.0, 0.3], 0.25)
    grid_chain(1201, [-0.3, 0.0, 0.3], 0.15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sparse_chain(np.ones((2, 3))), "square"),
        (lambda: sparse_chain(np.ones((2, 2))), "sum to at most 1"),
        (lambda: smooth(sparse_chain(np.eye(3)), np.ones((4, 2))), "divisor of 3"),
        (lambda: smooth(sparse_chain(np.eye(3)), np.zeros((4, 3))), "positive"),
        (lambda: smooth(sparse_chain(np.eye(3)), np.full((4, 3), np.nan)), "positive"),
        (lambda: smooth(sparse_chain(np.eye(3)), np.ones((4, 3)), np.zeros(3)), "prior"),
        (lambda: smooth(sparse_chain(np.eye(3)), np.ones((4, 3)), negligible=0.1), "negligible must lie in"),
        (lambda: best_path(sparse_chain(np.eye(3)), np.ones((0, 3))), "log_likelihood"),
        (lambda: presence([1.0, -1.0]), "existence_likelihood"),
        (lambda: presence([1.0], switching=0.0), "switching"),
        (lambda: grid_chain(10, [0.0, 0.5, 0.7], 0.25), "equal steps"),
        (lambda: grid_chain(1, [0.0], 0.25), "positions"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("scale", [1e-300, 1e-17, 1.0, 1e17, 1e300])
@pytest.mark.parametrize("width", [0.03, 1.0])
def test_likelihoods_of_any_size_give_the_posterior_of_their_shape(scale: float, width: float) -> None:
    chain = grid_chain(positions=21, rates=[-1.0, 0.0, 1.0], spacing=0.5)
    rng = np.random.default_rng(3)
    middle = rng.uniform(5.0, 15.0, (12, 1))
    shape = np.maximum(np.exp(-0.5 * ((np.arange(21) - middle) / width) ** 2), 1e-290 / min(scale, 1.0))
    smoothed = smooth(chain, shape * scale)
    plain = smooth(chain, shape)
    assert np.isfinite(smoothed.marginal).all()
    assert np.allclose(smoothed.marginal.sum(axis=1), 1.0, rtol=1e-9)
    assert np.allclose(smoothed.marginal, plain.marginal, rtol=1e-6, atol=1e-9)
    assert np.allclose(smoothed.log_evidence, plain.log_evidence + 12 * np.log(scale), rtol=1e-9)
    assert np.allclose(np.log(smoothed.existence_likelihood), np.log(plain.existence_likelihood) + np.log(scale))


def test_both_recursions_agree_where_both_hold() -> None:
    chain = grid_chain(positions=15, rates=[-1.0, 0.0, 1.0], spacing=0.5)
    rng = np.random.default_rng(0)
    likelihood, presence = np.exp(rng.normal(0.0, 3.0, (10, 15))), rng.uniform(0.0, 1.0, 10)
    prior = rng.random(45)
    hidden = np.append(presence, 0.0)
    plain = smooth(chain, np.vstack([likelihood, np.ones(15)]), prior, hidden)
    # One extreme row, which the presence hides, selects the recursion in logarithms for all rows.
    other = smooth(chain, np.vstack([likelihood, np.full(15, 1e200)]), prior, hidden)
    assert np.allclose(other.marginal, plain.marginal, rtol=1e-9, atol=1e-12)
    assert np.allclose(other.existence_likelihood[:10], plain.existence_likelihood[:10], rtol=1e-9)
    assert other.log_evidence == pytest.approx(plain.log_evidence, rel=1e-9)


def test_a_narrow_likelihood_divides_by_nothing() -> None:
    chain = grid_chain(positions=31, rates=[-1.0, 0.0, 1.0], spacing=0.5)
    with np.errstate(all="raise"):
        smoothed = smooth(chain, np.tile(np.exp(-0.5 * (np.arange(31) - 15.0) ** 2 / 1.6**2), (5, 1)))
        after = advance(chain, chain.uniform(), np.geomspace(1e-300, 1e300, 31), presence=0.9)
    assert np.isfinite(smoothed.existence_likelihood).all()
    assert np.isfinite(after).all() and after.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"presence": [0.5, np.nan]}, "presence must be probabilities from 0 to 1, got nan at index \\[1\\]"),
        ({"presence": [0.5, 1.5]}, "presence must be probabilities from 0 to 1"),
        ({"prior": np.full(9, np.inf)}, "prior must be finite"),
        ({"likelihood": [["a"] * 9] * 2}, "likelihood must be real numbers, got text"),
        ({"likelihood": np.ones((2, 9)) * 1j}, "likelihood must be real numbers, got complex numbers"),
    ],
)
def test_bad_arguments_of_the_smoother_are_named(arguments: dict, message: str) -> None:
    chain = grid_chain(positions=9, rates=[0.0], spacing=0.5)
    with pytest.raises(ValueError, match=message):
        smooth(chain, **{"likelihood": np.ones((2, 9)), **arguments})


def test_presence_of_extreme_rows_is_finite() -> None:
    found = presence([1e308, 0.0, 1e308, 0.0, 1e-300, 1.0], switching=1e-300, prior=1.0 - 1e-16)
    assert np.isfinite(found).all() and ((found >= 0.0) & (found <= 1.0)).all()
