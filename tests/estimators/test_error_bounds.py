"""Cramer-Rao bounds and bounds on existence, against exact values, enumeration and filters."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from servotrack.estimators.rfs import PMB, Birth, constant_velocity
from servotrack.estimators.rfs.bounds import expected_distance, known_covariances
from servotrack.estimators.rfs.cramer_rao import cramer_rao_covariances, information_reduction
from servotrack.estimators.rfs.existence_bounds import Presence, joint_error, number_error

PLANE = constant_velocity(5.0, 1.5)
BIRTH = np.diag([100.0, 25.0, 100.0, 25.0])


@pytest.mark.parametrize("detection", [0.5, 0.9, 1.0])
def test_information_without_clutter_is_that_of_the_detections(detection):
    assert information_reduction(detection, 0.0, np.eye(2)) == detection
    found = information_reduction(detection, 1e-9, np.eye(2), samples=200_000)
    assert found == pytest.approx(detection, abs=4.0 * math.sqrt(1.0 / 200_000) + 1e-3)


@pytest.mark.parametrize(("detection", "kappa"), [(0.9, 0.05), (1.0, 0.01), (0.6, 0.02)])
def test_information_of_one_coordinate_is_the_integral_over_scans(detection, kappa):
    # Scans of one and two measurements within +-7 by quadrature; more are rare at these rates.
    edge, points = 7.0, 1401
    u = np.linspace(-edge, edge, points)
    step = u[1] - u[0]
    phi = np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi)
    mean = kappa * 2.0 * edge
    total = 0.0
    for number in (1, 2):
        values = np.meshgrid(*[u] * number, indexing="ij")
        densities = [phi[np.searchsorted(u, value)] for value in values]
        ratio = detection / kappa * sum(densities)
        gradient = detection / kappa * sum(d * v for d, v in zip(densities, values, strict=True))
        likelihood = 1.0 - detection + ratio
        weight = math.exp(-mean) * kappa**number / math.factorial(number)
        total += float((weight * gradient**2 / likelihood).sum() * step**number)
    # More measurements: |g|^2 is at most that of the target's own measurement, by Jensen's inequality.
    left = detection * (1.0 - math.exp(-mean) * (1.0 + mean))
    found = information_reduction(detection, kappa, [[1.0]], samples=400_000)
    assert total - 0.005 < found < total + left + 0.005


def test_information_falls_with_clutter_and_does_not_depend_on_units():
    R = np.array([[4.0, 1.0], [1.0, 2.0]])
    rates = [information_reduction(0.9, kappa, R, samples=4000) for kappa in (1e-4, 1e-2, 0.1, 1.0, 5.0)]
    assert all(a > b for a, b in itertools.pairwise(rates))
    assert rates[-1] < 0.1
    scaled = information_reduction(0.9, 0.1 / 1e6, 1e6 * R, samples=4000)
    assert scaled == pytest.approx(rates[2], abs=1e-9)


@pytest.mark.parametrize("lag", [0, 3])
def test_bound_of_known_detections_is_the_kalman_covariance(lag):
    detected = np.array([True, False, True, True, False, False, True, True])
    H, R = PLANE.observation, PLANE.measurement_noise
    information = detected[:, None, None] * (H.T @ np.linalg.inv(R) @ H)
    found = cramer_rao_covariances(PLANE.transition, PLANE.process_noise, BIRTH, information, lag)
    np.testing.assert_allclose(found, known_covariances(PLANE, BIRTH, detected, lag), rtol=1e-7, atol=1e-8)


def test_probabilistic_data_association_is_near_the_bound_and_not_below_it():
    detection, kappa, scans, runs = 0.8, 0.001, 12, 1500
    model = constant_velocity(1.0, 1.5)
    F, Q, H, R = model.transition, model.process_noise, model.observation, model.measurement_noise
    start, side = np.diag([4.0, 1.0, 4.0, 1.0]), 60.0
    q = information_reduction(detection, kappa, R)
    assert 0.6 < q < 0.75
    clean = np.broadcast_to(H.T @ np.linalg.inv(R) @ H, (scans, 4, 4))
    bound, without = (cramer_rao_covariances(F, Q, start, share * clean) for share in (q, 1.0))
    rng, root = np.random.default_rng(100_000), np.linalg.cholesky(Q)
    errors = np.empty((runs, scans))
    for run in range(runs):
        x, mean, P = np.linalg.cholesky(start) @ rng.standard_normal(4), np.zeros(4), start
        for k in range(scans):
            if k:
                x, mean, P = F @ x + root @ rng.standard_normal(4), F @ mean, F @ P @ F.T + Q
            own = (H @ x + 1.5 * rng.standard_normal(2))[None][: int(rng.random() < detection)]
            clutter = rng.uniform(-side / 2, side / 2, (rng.poisson(kappa * side**2), 2)) + x[[0, 2]]
            d = np.concatenate([own, clutter]) - H @ mean
            S = H @ P @ H.T + R
            K = P @ H.T @ np.linalg.inv(S)
            density = np.exp(-0.5 * np.einsum("zi,ij,zj->z", d, np.linalg.inv(S), d))
            weight = detection * density / math.sqrt(np.linalg.det(2.0 * np.pi * S)) / kappa
            weight, missed = (
                weight / (1.0 - detection + weight.sum()),
                (1.0 - detection) / (1.0 - detection + weight.sum()),
            )
            step = d @ K.T
            move = weight @ step
            P = missed * P + (1.0 - missed) * (P - K @ S @ K.T) + (step.T * weight) @ step - np.outer(move, move)
            mean = mean + move
            errors[run, k] = ((mean - x)[[0, 2]] ** 2).sum()
    found, spread = errors.mean(axis=0), errors.std(axis=0, ddof=1) / math.sqrt(runs)
    least, clean_least = bound[:, 0, 0] + bound[:, 2, 2], without[:, 0, 0] + without[:, 2, 2]
    assert np.all(found + 2.0 * spread > least)
    # Later a few runs are lost in clutter, which the bound does not know.
    assert np.all(np.sqrt(found / least)[:3] < 1.4)
    assert least.mean() > 1.2 * clean_least.mean()


@pytest.mark.parametrize(("birth", "survival", "detection"), [(0.2, 0.9, 0.7), (0.5, 0.6, 0.95), (0.05, 1.0, 0.3)])
def test_existence_without_clutter_is_that_of_the_enumerated_histories(birth, survival, detection):
    scans = 5
    presence = Presence(birth, survival, detection)
    wanted = 0.0
    for seen in itertools.product((False, True), repeat=scans):
        alive, absent = 0.0, 1.0
        for one in seen:
            alive, absent = alive * survival + absent * birth, alive * (1.0 - survival) + absent * (1.0 - birth)
            alive *= detection if one else 1.0 - detection
            absent *= 0.0 if one else 1.0
        wanted += min(alive, absent)
    truth, chance = presence.simulate(scans, 200_000, 1)
    errors = np.minimum(chance[:, -1], 1.0 - chance[:, -1])
    assert errors.mean() == pytest.approx(wanted, abs=4.0 * errors.std() / math.sqrt(len(errors)) + 1e-12)
    # The posterior is calibrated: the best guess is wrong as often as it says.
    wrong = (chance[:, -1] > 0.5) != (truth[:, -1] > 0.5)
    assert wrong.mean() == pytest.approx(wanted, abs=0.005)


@pytest.mark.parametrize("clutter", [0.01, 0.3, 1.0])
def test_probabilities_in_clutter_are_calibrated(clutter):
    truth, chance = Presence(0.1, 0.9, 0.8, clutter).simulate(10, 30_000, 2)
    for low in np.arange(0.0, 1.0, 0.1):
        inside = (chance >= low) & (chance < low + 0.1)
        if inside.sum() > 2000:
            assert truth[inside].mean() == pytest.approx(chance[inside].mean(), abs=0.02)


@pytest.mark.parametrize("clutter", [0.003, 0.05])
def test_pmb_told_the_birth_makes_no_fewer_errors_of_existence(clutter):
    # One target that appears at a known place, and whose place the filter must follow: it knows less than the bound.
    scans, runs, R = 10, 400, PLANE.measurement_noise
    kappa = clutter / math.sqrt(np.linalg.det(2.0 * math.pi * R))
    presence = Presence(0.1, 0.9, 0.8, clutter)
    _, chance = presence.simulate(scans, 100_000, 3)
    bound = np.minimum(chance, 1.0 - chance).mean(axis=0)
    rng = np.random.default_rng(100_001)
    place = np.diag([4.0, 1e-6, 4.0, 1e-6])
    model = constant_velocity(1e-3, 1.5)
    filter = PMB(
        model, Birth([0.1], [np.zeros(4)], place), clutter_intensity=kappa, survival=0.9, detection=0.8, threshold=0.5
    )
    wrong = np.zeros(scans)
    for _ in range(runs):
        state, alive = filter.initial(np.zeros((0, 2))), False
        for k in range(scans):
            if not alive:
                x = 2.0 * rng.standard_normal(2)
            alive = rng.random() < (0.9 if alive else 0.1)
            own = (x + 1.5 * rng.standard_normal(2))[None][: int(alive and rng.random() < 0.8)]
            clutter_points = rng.uniform(-30.0, 30.0, (rng.poisson(kappa * 3600.0), 2))
            state, estimate = filter.step(state, np.concatenate([own, clutter_points]))
            wrong[k] += min(abs(len(estimate.labels) - alive), 1)
    error = wrong / runs
    assert np.all(error + 3.0 * np.sqrt(error * (1.0 - error) / runs + 1e-6) > bound)
    assert error.mean() < 4.0 * bound.mean() + 0.05


def test_error_of_the_number_is_that_of_the_median():
    rng = np.random.default_rng(4)
    for _ in range(20):
        r = rng.random(5)
        outcomes = np.array(list(itertools.product((0, 1), repeat=5)))
        weights = np.prod(np.where(outcomes, r, 1.0 - r), axis=1)
        numbers = outcomes.sum(axis=1)
        wanted = min((weights * np.abs(numbers - guess)).sum() for guess in range(6))
        assert number_error(r) == pytest.approx(wanted, abs=1e-12)
    assert number_error(np.array([0.5, 0.5])) == pytest.approx(0.5)
    assert number_error(np.zeros((3, 0))).tolist() == [0.0, 0.0, 0.0]


def test_joint_error_is_the_better_of_reporting_and_not():
    d = expected_distance(np.array([[4.0, 0.0], [0.0, 9.0]]), 10.0)
    r = np.linspace(0.0, 1.0, 101)
    found = joint_error(r, d, 10.0)
    np.testing.assert_allclose(found, np.minimum(5.0 * r, 5.0 * (1.0 - r) + r * d))
    assert found[0] == 0.0
    assert found[-1] == pytest.approx(d)
    assert np.argmax(found) == np.argmin(np.abs(5.0 * r - 5.0 * (1.0 - r) - r * d))


def test_bad_arguments_are_refused_by_name():
    for call, message in (
        (lambda: information_reduction(0.0, 1.0, np.eye(2)), r"detection must be in \(0, 1\], got 0"),
        (lambda: information_reduction(0.9, -1.0, np.eye(2)), "clutter_intensity must be finite and >= 0"),
        (lambda: information_reduction(0.9, 1.0, -np.eye(2)), "noise must be a positive definite matrix"),
        (lambda: information_reduction(0.9, 1.0, np.eye(2), samples=0), "samples must be at least 1"),
        (lambda: cramer_rao_covariances(np.eye(2), np.eye(2), np.eye(2), np.eye(2)), r"information must have shape"),
        (lambda: cramer_rao_covariances(np.eye(1), np.eye(1), np.zeros((1, 1)), np.ones((2, 1, 1))), "birth_covar"),
        (lambda: cramer_rao_covariances(np.eye(1), np.eye(1), np.eye(1), np.ones((2, 1, 1)), -1), "lag must be"),
        (lambda: Presence(1.5, 0.9, 0.9), "birth must be in"),
        (lambda: Presence(0.5, 0.9, 0.9, -1.0), "clutter must be finite"),
        (lambda: Presence(0.5, 0.9, 0.9, 1.0, 0), "dimensions must be at least 1"),
        (lambda: Presence(0.5, 0.9, 0.9).simulate(0, 1), "scans and runs must be at least 1"),
        (lambda: number_error(np.array([1.5])), "existence must be in"),
        (lambda: joint_error(np.array([0.5]), np.array([-1.0]), 10.0), "distance must be >= 0"),
        (lambda: joint_error(np.array([0.5]), np.array([1.0]), 0.0), "cutoff must be > 0"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
