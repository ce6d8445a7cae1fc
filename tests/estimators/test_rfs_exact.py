"""Set filters against what is known exactly: a plain reference, the Bernoulli filter, enumeration, and each other."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    PMBM,
    Birth,
    GMCBMeMBer,
    PairwiseMarkovModel,
    Reduction,
    Spawn,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.rfs.association import association_marginals
from servotrack.estimators.rfs.extraction import most_probable_number
from servotrack.estimators.rfs.reduction import Candidates, Components, reduce_mixture
from servotrack.estimators.stateful import Stateful

KAPPA = 20.0 / 4000.0**2
HMM = constant_velocity(5.0, 1.5)
S1 = pairwise_structure(HMM, "S1")
UNMERGED = Reduction(prune=1e-7, merge=0.0, components=400, tracks=100)
FILTERS = [GMPHD, GMCBMeMBer, PMB, PMBM]


def places(weight=0.03):
    means = np.zeros((4, 4))
    means[:, [0, 2]] = (0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0)
    return Birth(np.full(4, weight), means, 100.0 * np.eye(4))


def scans(seed=100_000, steps=100, **axes):
    episode = draw_episode(clutter_config(0, **axes), seed)
    return [z[z[:, 0] == 1.0, 1:] for z in episode.measurements[:steps]]


def normal_pdf(z, mean, cov):
    d = z - mean
    return np.exp(-0.5 * d @ np.linalg.solve(cov, d)) / np.sqrt(np.linalg.det(2.0 * np.pi * cov))


@pytest.mark.parametrize("kind", FILTERS)
def test_pairwise_filter_without_memory_is_the_hidden_markov_filter(kind):
    without = PairwiseMarkovModel.from_hidden_markov(HMM, np.zeros((4, 2)), np.zeros((2, 2)))
    pair = [Stateful(kind(m, places(), clutter_intensity=KAPPA, reduction=UNMERGED)) for m in (HMM, without)]
    reported = 0
    for z in scans(steps=8, clutter_rate=5.0):
        a, b = (tracker.step(z) for tracker in pair)
        assert a.expected_number == pytest.approx(b.expected_number, abs=1e-9)
        np.testing.assert_allclose(a.states, b.states, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(a.existence, b.existence, atol=1e-9)
        np.testing.assert_array_equal(a.labels, b.labels)
        reported += len(a.states)
    assert reported >= 15


def reference_phd(measurements, p_s, p_d, birth, spawn=None):
    """Vo and Ma 2006 as the textbook has it, one component after the other, nothing reduced but by weight."""
    F, Q, H, R = HMM.transition, HMM.process_noise, HMM.observation, HMM.measurement_noise
    mixture = []
    for scan in measurements:
        predicted = [(p_s * w, F @ m, F @ P @ F.T + Q) for w, m, P in mixture]
        if spawn is not None:
            predicted += [(spawn.weight * w, m + spawn.offset, P + spawn.noise) for w, m, P in mixture]
        predicted += list(zip(birth.weights, birth.means, birth.covariances, strict=True))
        mixture = [((1.0 - p_d) * w, m, P) for w, m, P in predicted]
        for z in scan:
            updated = []
            for w, m, P in predicted:
                S = H @ P @ H.T + R
                K = P @ H.T @ np.linalg.inv(S)
                updated.append((p_d * w * normal_pdf(z, H @ m, S), m + K @ (z - H @ m), P - K @ H @ P))
            total = KAPPA + sum(u[0] for u in updated)
            mixture += [(w / total, m, P) for w, m, P in updated]
        mixture = [c for c in mixture if c[0] > UNMERGED.prune]
        yield sorted(mixture, key=lambda c: -c[0])


@pytest.mark.parametrize("spawn", [None, Spawn(0.02, 25.0 * np.eye(4), offset=np.array([5.0, 0.0, 0.0, 0.0]))])
def test_phd_is_the_textbook_recursion(spawn):
    measurements = scans(steps=5, clutter_rate=5.0)
    filter_ = GMPHD(
        HMM,
        places(),
        clutter_intensity=KAPPA,
        survival=0.95,
        detection=0.9,
        reduction=Reduction(prune=UNMERGED.prune, merge=0.0, components=2000),
        spawn=() if spawn is None else (spawn,),
        gate_probability=1.0,
    )
    tracker = Stateful(filter_)
    for z, wanted in zip(measurements, reference_phd(measurements, 0.95, 0.9, places(), spawn), strict=True):
        tracker.step(z)
        mixture = tracker.state.intensity
        assert int(mixture.number) == len(wanted)
        np.testing.assert_allclose(mixture.weight[: len(wanted)], [w for w, _, _ in wanted], rtol=1e-8, atol=1e-15)
        for i, (w, m, P) in enumerate(wanted[:15]):
            if i and abs(w - wanted[i - 1][0]) < 1e-9 * w:
                continue
            np.testing.assert_allclose(mixture.mean[i, :4], m, rtol=1e-7, atol=1e-6)
            np.testing.assert_allclose(mixture.covariance[i, :4, :4], P, rtol=1e-7, atol=1e-6)


def likelihood_of_birth(model, birth, z):
    H, R = model.observation, model.measurement_noise
    return normal_pdf(z, H @ birth.means[0], H @ birth.covariances[0] @ H.T + R)


@settings(max_examples=60, deadline=None)
@given(
    r=st.floats(0.01, 0.99),
    p_d=st.floats(0.0, 1.0),
    offset=st.floats(-30.0, 30.0),
    kappa=st.sampled_from([1e-8, 1e-6, 1e-4]),
    model=st.sampled_from([HMM, S1]),
)
def test_one_track_and_one_measurement_make_the_exact_bernoulli_filter(r, p_d, offset, kappa, model):
    z = np.array([[offset, 0.3 * offset]])
    birth = Birth([r], np.zeros((1, 4)), 100.0 * np.eye(4))
    rho = p_d * likelihood_of_birth(model, birth, z[0])
    exact = (r * (1.0 - p_d) * kappa + r * rho) / (kappa * (1.0 - r * p_d) + r * rho)
    filter_ = GMCBMeMBer(
        model, birth, clutter_intensity=kappa, detection=p_d, gate_probability=1.0, reduction=Reduction(existence=0.0)
    )
    state, _ = filter_.step(filter_.initial(z), z)
    assert float(state.tracks.existence.sum()) == pytest.approx(exact, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("model", [HMM, S1])
def test_an_isolated_detected_target_splits_its_existence_as_the_formula_says(model):
    r, p_d = 0.99, 0.98
    birth = Birth([r], np.zeros((1, 4)), 100.0 * np.eye(4))
    filter_ = GMCBMeMBer(model, birth, clutter_intensity=1e-15, detection=p_d)
    state, _ = filter_.step(filter_.initial(np.zeros((1, 2))), np.zeros((1, 2)))
    wanted = sorted([(1 - r) / (1 - r * p_d), r * (1 - p_d) / (1 - r * p_d)], reverse=True)
    np.testing.assert_allclose(state.tracks.existence[:2], wanted, rtol=1e-6)


def test_unbalanced_member_counts_too_many():
    measurements = scans()
    bias = {}
    for balanced in (True, False):
        tracker = Stateful(GMCBMeMBer(HMM, places(), clutter_intensity=KAPPA, balanced=balanced))
        bias[balanced] = sum(float(tracker.step(z).expected_number) for z in measurements)
    assert bias[False] > 1.05 * bias[True]


def exact_marginals(psi):
    T, Z = psi.shape
    weights, missed, assigned, fresh = 0.0, np.zeros(T), np.zeros((T, Z)), np.zeros(Z)
    for choice in itertools.product(range(-1, Z), repeat=T):
        used = [j for j in choice if j >= 0]
        if len(set(used)) < len(used):
            continue
        weight = np.prod([psi[i, j] for i, j in enumerate(choice) if j >= 0])
        weights += weight
        for i, j in enumerate(choice):
            if j < 0:
                missed[i] += weight
            else:
                assigned[i, j] += weight
        for j in set(range(Z)) - set(used):
            fresh[j] += weight
    return missed / weights, assigned / weights, fresh / weights


def belief(psi):
    T, Z = psi.shape
    track, measurement = np.nonzero(psi)
    missed, assigned, fresh = association_marginals(track, measurement, psi[track, measurement], T, Z)
    matrix = np.zeros((T, Z))
    matrix[track, measurement] = assigned
    return missed, matrix, fresh


@settings(max_examples=100, deadline=None)
@given(values=st.lists(st.floats(0.0, 1e6), min_size=1, max_size=6), across=st.booleans())
def test_belief_propagation_is_exact_without_loops(values, across):
    psi = np.array(values).reshape((1, -1) if across else (-1, 1))
    for got, wanted in zip(belief(psi), exact_marginals(psi), strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(psi=st.lists(st.one_of(st.floats(0.0, 900.0), st.floats(0.0, 1e12)), min_size=9, max_size=9))
def test_belief_propagation_gives_probabilities_that_sum_to_one(psi):
    psi = np.array(psi).reshape(3, 3)
    missed, assigned, fresh = belief(psi)
    assert np.all((assigned >= 0.0) & (missed >= 0.0) & (fresh >= 0.0))
    np.testing.assert_allclose(missed + assigned.sum(axis=1), 1.0, atol=1e-9)
    if psi.max() < 1e3:
        # The measurements' side agrees as far as the messages have converged.
        np.testing.assert_allclose(fresh + assigned.sum(axis=0), 1.0, atol=1e-3)


def test_pmb_of_one_target_is_the_exact_bernoulli_filter():
    p_s, p_d, kappa, r0 = 0.97, 0.9, 1e-5, 0.4
    H, R, F, Q = HMM.observation, HMM.measurement_noise, HMM.transition, HMM.process_noise
    birth = Birth([r0], np.zeros((1, 4)), 100.0 * np.eye(4))
    filter_ = PMB(HMM, birth, clutter_intensity=kappa, survival=p_s, detection=p_d, gate_probability=1.0)
    z = np.array([[1.0, -2.0]])
    state, _ = filter_.step(filter_.initial(z), z)
    q = likelihood_of_birth(HMM, birth, z[0])
    r = p_d * r0 * q / (kappa + p_d * r0 * q)
    assert state.tracks.existence[0] == pytest.approx(r, rel=1e-9)
    # The second step: one track, one measurement far from the birth's place, so that the births do not interfere.
    P = 100.0 * np.eye(4)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    m, P = K @ z[0], P - K @ H @ P
    m, P, r = F @ m, F @ P @ F.T + Q, p_s * r
    z = np.array([[0.5, -1.0]])
    nowhere = Birth([1e-12], np.full((1, 4), 1e6), P)
    options = {"clutter_intensity": kappa, "survival": p_s, "detection": p_d, "gate_probability": 1.0}
    silent = PMB(HMM, nowhere, **options)
    state, _ = silent.step(state._replace(undetected=silent.initial(z).undetected), z)
    rho = p_d * normal_pdf(z[0], H @ m, H @ P @ H.T + R)
    exact = (r * (1.0 - p_d) * kappa + r * rho) / (kappa * (1.0 - r * p_d) + r * rho)
    assert state.tracks.existence[0] == pytest.approx(exact, rel=1e-5)


@settings(max_examples=60, deadline=None)
@given(existence=st.lists(st.floats(0.0, 1.0), min_size=0, max_size=7))
def test_most_probable_number_is_that_of_the_enumerated_tracks(existence):
    r = np.array(existence)
    pmf = np.zeros(len(r) + 1)
    for alive in itertools.product([0, 1], repeat=len(r)):
        pmf[sum(alive)] += np.prod(np.where(alive, r, 1.0 - r))
    assert pmf[most_probable_number(r)] == pytest.approx(pmf.max(), abs=1e-12)


def reduced(weight, mean, cov, merge, cap):
    C, n = mean.shape
    indices = np.arange(C)
    candidates = Candidates(weight, mean, indices, np.full(C, -1), indices + 1)
    out = Components(
        np.zeros(cap), np.zeros((cap, n)), np.zeros((cap, n, n)), np.zeros(cap, np.bool_), np.zeros(cap, np.int64)
    )
    limits = Reduction(prune=0.0, merge=merge, components=cap).limits
    count = reduce_mixture(False, n, candidates, indices, cov, cov, limits, cap, out, 0)
    return tuple(part[:count] for part in out)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), merge=st.sampled_from([0.0, 1.0, 4.0, 1e6]), size=st.integers(1, 30))
def test_merging_keeps_the_mixtures_mass_mean_and_covariance(seed, merge, size):
    rng = np.random.default_rng(seed)
    weight, mean = rng.uniform(0.1, 1.0, size), rng.normal(0.0, 3.0, (size, 3))
    spread = rng.normal(size=(size, 3, 3))
    cov = spread @ np.swapaxes(spread, 1, 2) + 0.1 * np.eye(3)
    w, m, P, _, label = reduced(weight, mean, cov, merge, size)

    def moments(w, m, P):
        average = w @ m / w.sum()
        d = m - average
        return w.sum(), average, np.einsum("i,ijk->jk", w, P + d[:, :, None] * d[:, None, :]) / w.sum()

    for a, b in zip(moments(w, m, P), moments(weight, mean, cov), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    assert np.all(np.diff(w) <= 1e-15)
    assert len(set(label)) == len(label)
    assert (len(w) == size) if merge == 0.0 else (len(w) <= size)


def test_cap_keeps_the_heaviest():
    weight, mean = np.array([0.1, 0.9, 0.5, 0.7]), 100.0 * np.arange(4.0)[:, None]
    w, m, _, _, _ = reduced(weight, mean, np.ones((4, 1, 1)), 4.0, 2)
    np.testing.assert_array_equal(w, [0.9, 0.7])
    np.testing.assert_array_equal(m[:, 0], [100.0, 300.0])
