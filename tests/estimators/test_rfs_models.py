"""Models of one target: the pairwise Markov model's algebra, its definiteness condition and its Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.rfs import (
    STRUCTURES,
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    constant_velocity,
    definiteness_margin,
    pairwise_structure,
)
from servotrack.estimators.rfs.gaussians import attach_measurement, condition_gaussian, detected_mean, predict_gaussian

NOISE = {"S1": (5.0, 1.5), "S2": (5.0, 2.5), "S3": (5.0, 1.5), "S4": (5.0, 10.0), "S5": (5.0, 10.0), "S6": (5.0, 10.0)}


def predicted(model, mean, cov, detected):
    packed = model.packed
    size = len(mean)
    out_mean, out_cov = np.zeros(size), np.zeros((size, size))
    predict_gaussian(packed, mean, cov, detected, np.zeros((size, size)), out_mean, out_cov)
    return out_mean, out_cov


def conditioned(model, mean, cov, z):
    packed = model.packed
    m, n = packed.observation.shape
    gain, posterior, out = np.zeros((n, m)), np.zeros((n, n)), np.zeros(n + m)
    condition_gaussian(packed, cov, np.zeros((m, m)), gain, posterior)
    detected_mean(packed, mean, gain, z, np.zeros(m), out)
    joint = np.zeros((n + m, n + m))
    joint[:n, :n] = posterior
    return out, joint


@pytest.mark.parametrize("structure", STRUCTURES)
def test_structures_keep_the_local_laws_of_the_hidden_markov_model(structure):
    hmm = constant_velocity(*NOISE[structure])
    pmm = pairwise_structure(hmm, structure)
    F, Q, H, R = hmm.transition, hmm.process_noise, hmm.observation, hmm.measurement_noise
    B, sigma = pmm.transition, pmm.noise
    # Law of (x_k, y_k) given x_{k-1} when y_{k-1} | x_{k-1} ~ N(H x_{k-1}, R), the previous measurement summed over.
    onto_state = B[:, :4] + B[:, 4:] @ H
    covariance = sigma + B[:, 4:] @ R @ B[:, 4:].T
    np.testing.assert_allclose(onto_state[:4], F, atol=1e-12)
    np.testing.assert_allclose(covariance[:4, :4], Q, atol=1e-9)
    # y_k - H x_k has mean zero, variance R and no correlation with x_k whatever x_{k-1} was.
    residual = np.hstack([-H, np.eye(2)])
    np.testing.assert_allclose(residual @ onto_state, 0.0, atol=1e-12)
    np.testing.assert_allclose(residual @ covariance @ residual.T, R, atol=1e-9)
    np.testing.assert_allclose(residual @ covariance[:, :4], 0.0, atol=1e-9)


@pytest.mark.parametrize("structure", ["S1", "S3", "S6"])
def test_simulated_pairs_have_the_moments_of_the_hidden_markov_model(structure):
    hmm = constant_velocity(*NOISE[structure])
    pmm = pairwise_structure(hmm, structure)
    rng = np.random.default_rng(3)
    runs = 200_000
    x = rng.multivariate_normal(np.zeros(4), 100.0 * np.eye(4), runs)
    y = x @ hmm.observation.T + rng.multivariate_normal(np.zeros(2), hmm.measurement_noise, runs)
    for _ in range(3):
        before = x
        xi = np.hstack([x, y]) @ pmm.transition.T + rng.multivariate_normal(np.zeros(6), pmm.noise, runs)
        x, y = xi[:, :4], xi[:, 4:]
    u, v = x - before @ hmm.transition.T, y - x @ hmm.observation.T
    # Sample covariances of 200,000 draws scatter by some 0.3 %; 2 % is six standard deviations.
    scale = np.sqrt(np.outer(np.diag(hmm.process_noise), np.diag(hmm.process_noise)))
    assert np.abs(np.cov(u.T) - hmm.process_noise).max() <= 0.02 * scale.max()
    assert np.abs(np.cov(v.T) - hmm.measurement_noise).max() <= 0.02 * hmm.measurement_noise.max()
    assert np.abs(v.T @ before / runs).max() <= 0.02 * v.std() * before.std()
    assert np.abs(v.T @ x / runs).max() <= 0.02 * v.std() * x.std()


@settings(max_examples=200, deadline=None)
@given(
    f2=st.lists(st.floats(-1.2, 1.2), min_size=8, max_size=8),
    h2=st.lists(st.floats(-1.2, 1.2), min_size=4, max_size=4),
    sigma_v=st.floats(0.5, 20.0),
    sigma_w=st.floats(0.5, 20.0),
)
def test_definiteness_condition_agrees_with_the_eigenvalues(f2, h2, sigma_v, sigma_w):
    hmm = constant_velocity(sigma_v, sigma_w)
    F2, H2 = np.reshape(f2, (4, 2)), np.reshape(h2, (2, 2))
    G = np.vstack([F2, H2])
    sigma = hmm.joint_noise - G @ hmm.measurement_noise @ G.T
    smallest = np.linalg.eigvalsh(sigma).min() / np.abs(sigma).max()
    margin = definiteness_margin(hmm, F2, H2)
    if abs(smallest) < 1e-9 or abs(margin) < 1e-9:
        return
    assert (margin > 0.0) == (smallest > 0.0)
    if margin > 0.0:
        PairwiseMarkovModel.from_hidden_markov(hmm, F2, H2)
    else:
        with pytest.raises(ValueError, match=r"R\^-1 - F2\^T Q\^-1 F2"):
            PairwiseMarkovModel.from_hidden_markov(hmm, F2, H2)


@pytest.mark.parametrize(
    ("structure", "ratio"), [("S1", 9.1875), ("S2", 3.0625), ("S3", 5.08 / 0.51), ("S4", 0.1875), ("S5", 0.0625)]
)
def test_structures_need_the_noise_ratio_that_the_condition_gives(structure, ratio):
    for factor, fits in ((1.0 + 1e-6, True), (1.0 - 1e-6, False)):
        hmm = constant_velocity(np.sqrt(ratio * factor), 1.0)
        if fits:
            pairwise_structure(hmm, structure)
        else:
            with pytest.raises(ValueError, match="F2 and H2 must keep"):
                pairwise_structure(hmm, structure)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_pairwise_kalman_filter_is_the_kalman_filter_on_state_and_measurement_error(structure):
    hmm = constant_velocity(*NOISE[structure])
    pmm = pairwise_structure(hmm, structure)
    H, R = hmm.observation, hmm.measurement_noise
    # (x, r) with r = y - H x, a linear image of (x, y); its measurement [H I] has no noise.
    T = np.block([[np.eye(4), np.zeros((4, 2))], [-H, np.eye(2)]])
    A, W, C = T @ pmm.transition @ np.linalg.inv(T), T @ pmm.noise @ T.T, np.hstack([H, np.eye(2)])
    m, P = np.array([100.0, 5.0, -50.0, 2.0, 0.0, 0.0]), np.zeros((6, 6))
    P[:4, :4], P[4:, 4:] = 25.0 * np.eye(4), R
    mean, cov, detected = np.zeros(6), np.zeros((6, 6)), False
    mean[:4], cov[:4, :4] = m[:4], P[:4, :4]
    attach_measurement(pmm.packed, mean, cov)
    rng = np.random.default_rng(5)
    for step in range(40):
        m, P = A @ m, A @ P @ A.T + W
        mean, cov = predicted(pmm, mean, cov, detected)
        detected = step % 5 not in (2, 3)
        if detected:
            z = C @ m + rng.standard_normal(2) * 3.0
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T)
            m, P = m + K @ (z - C @ m), P - K @ C @ P
            mean, cov = conditioned(pmm, mean, cov, z)
        np.testing.assert_allclose(mean[:4], m[:4], rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(cov[:4, :4], P[:4, :4], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("transform", ["ekf", "ukf"])
def test_range_bearing_transforms_agree_with_sampling_far_from_the_sensor(transform):
    linear = constant_velocity(1.0, 1.0)
    noise = np.diag([4.0, 1e-4])
    model = RangeBearingModel(
        linear.transition, linear.process_noise, linear.observation, noise, (100.0, -50.0), transform
    )
    rng = np.random.default_rng(0)
    spread = rng.standard_normal((4, 4))
    cov = np.zeros((6, 6))
    cov[:4, :4] = 25.0 * (spread @ spread.T + np.eye(4))
    # Straight behind the sensor, where bearings jump from -pi to pi.
    mean = np.array([-900.0, 3.0, -50.0, 1.0, 0.0, 0.0])
    x = rng.multivariate_normal(mean[:4], cov[:4, :4], 400_000)
    attach_measurement(model.packed, mean, cov)
    offset = x[:, [0, 2]] - np.array([100.0, -50.0])
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - mean[5]
    y = np.stack([np.hypot(*offset.T) - mean[4], (turn + np.pi) % (2 * np.pi) - np.pi], axis=1)
    y += rng.standard_normal(y.shape) * np.sqrt(np.diag(noise))
    sample = np.cov(np.hstack([x, y]).T)
    scale = np.sqrt(np.diag(sample))
    assert np.abs((cov - sample) / np.outer(scale, scale)).max() < 0.01
    assert np.abs(y.mean(axis=0) / scale[4:]).max() < 0.05


def test_bad_models_are_refused_by_name():
    good = constant_velocity(5.0, 1.5)
    with pytest.raises(ValueError, match="measurement_noise must be positive definite"):
        HiddenMarkovModel(good.transition, good.process_noise, good.observation, np.diag([1.0, 0.0]))
    with pytest.raises(ValueError, match="process_noise must be symmetric"):
        HiddenMarkovModel(good.transition, np.triu(np.ones((4, 4))), good.observation, np.eye(2))
    with pytest.raises(ValueError, match="observation must be a matrix of shape"):
        HiddenMarkovModel(good.transition, good.process_noise, np.eye(3), np.eye(2))
    with pytest.raises(ValueError, match="transition must be finite"):
        HiddenMarkovModel(np.full((4, 4), np.nan), good.process_noise, good.observation, np.eye(2))
    with pytest.raises(ValueError, match=r"process_noise must be finite and > 0, got 0\.0"):
        constant_velocity(0.0, 1.0)
    with pytest.raises(ValueError, match="structure must be one of"):
        pairwise_structure(good, "S7")  # type: ignore[arg-type]
    singular = HiddenMarkovModel(
        good.transition, np.kron(np.eye(2), [[0.25, 0.5], [0.5, 1.0]]), good.observation, good.measurement_noise
    )
    with pytest.raises(ValueError, match="F2 and H2 must keep"):
        pairwise_structure(singular, "S6")
