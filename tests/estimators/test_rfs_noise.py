"""Measurements of one scan that are not equally exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servotrack.estimators.rfs import (
    GMPHD,
    LMB,
    PMB,
    PMBM,
    Birth,
    FunctionSensor,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    LinearSensor,
    MeasurementBirth,
    RangeBearingModel,
    Reduction,
    RobustPMB,
    TimedTracker,
    TrajectoryPMB,
    constant_velocity,
    maneuvers,
    match_measurements,
    pairwise_structure,
    range_bearing_sensor,
)

PLANE = constant_velocity(5.0, 1.5)
KAPPA = 20.0 / 4000.0**2
UNMERGED = Reduction(components=5, merge=0.0)
OTHER = np.array([[9.0, 2.0], [2.0, 4.0]])
GAUSSIAN = [GMPHD, GMCBMeMBer, LMB, PMB, PMBM, TrajectoryPMB, RobustPMB, GlobalNearestNeighbor]


def make(kind, model=PLANE, birth=None):
    if kind is GlobalNearestNeighbor:
        return kind(model)
    birth = MeasurementBirth(0.1, 10.0) if birth is None else birth
    options = {"clutter_intensity": KAPPA, "detection": 0.9}
    if kind is RobustPMB:
        options |= {"volume": 4000.0**2, "modes": maneuvers(model), "adaptation": None}
    return kind(model, birth, **options)


def scene(seed, steps=12):
    """Scans of two crossing targets, some missed, in clutter near them."""
    rng = np.random.default_rng(seed)
    scans = []
    for k in range(steps):
        true = np.array([[10.0 * k, -30.0 + 5.0 * k], [10.0 * k, 30.0 - 5.0 * k]])
        seen = true[rng.random(2) < 0.85] + rng.normal(0.0, 2.5, 2)
        scans.append(np.vstack([seen, true.mean(axis=0) + rng.uniform(-60.0, 60.0, (rng.poisson(2.0), 2))]))
    return scans


def assert_equal(one, other, scale=1e-8):
    np.testing.assert_array_equal(one.labels, other.labels)
    np.testing.assert_allclose(one.existence, other.existence, atol=1e-9)
    np.testing.assert_allclose(one.states, other.states, atol=scale)
    np.testing.assert_allclose(one.covariances, other.covariances, rtol=1e-7, atol=scale)
    np.testing.assert_allclose(one.expected_number, other.expected_number, atol=1e-9)


@pytest.mark.parametrize("kind", GAUSSIAN)
def test_one_noise_for_all_measurements_is_a_sensor_with_that_noise(kind):
    filter, sensor = make(kind), LinearSensor(PLANE.observation, OTHER)
    scans = scene(100_000)
    told, exchanged = filter.initial(scans[0]), filter.initial(scans[0])
    for z in scans:
        told, got = filter.step(told, z, noise=np.broadcast_to(OTHER, (len(z), 2, 2)))
        exchanged, wanted = filter.step(exchanged, z, sensor=sensor)
        assert_equal(got, wanted)
    assert len(got.labels) >= 1


@pytest.mark.parametrize("kind", GAUSSIAN)
def test_the_models_own_noise_changes_nothing(kind):
    filter, scans = make(kind), scene(100_001)
    told, plain = filter.initial(scans[0]), filter.initial(scans[0])
    for z in scans:
        told, got = filter.step(told, z, noise=np.broadcast_to(PLANE.measurement_noise, (len(z), 2, 2)))
        plain, wanted = filter.step(plain, z)
        assert_equal(got, wanted)


@pytest.mark.parametrize("kind", [GMPHD, PMB, TrajectoryPMB])
@pytest.mark.parametrize("form", ["ekf", "ukf", "function", "places"])
def test_nonlinear_sensors_take_it_too(kind, form):
    small, large = np.diag([4.0, 1e-4]), np.diag([25.0, 4e-4])
    x = PLANE.transition, PLANE.process_noise
    sensor, changed = None, None
    birth = Birth([0.1], [[60.0, 10.0, 30.0, 0.0]], np.diag([400.0, 25.0, 400.0, 25.0]))
    if form in ("ekf", "ukf"):
        model = RangeBearingModel(*x, np.eye(4)[[0, 2]], small, transform=form)
        other, birth = replace(model, measurement_noise=large), MeasurementBirth(0.1, 10.0)
        filter, reference = make(kind, model, birth), make(kind, other, birth)
    else:
        sensor, changed = range_bearing_sensor(2.0, 0.01), range_bearing_sensor(5.0, 0.02)
        if form == "places":
            birth = MeasurementBirth(0.1, 10.0)
        filter = reference = make(kind, PLANE, birth)
    rng = np.random.default_rng(100_000)
    told, wanted_state = filter.initial(np.zeros((0, 2)), sensor), reference.initial(np.zeros((0, 2)), changed)
    for k in range(10):
        position = np.array([60.0 + 10.0 * k, 30.0])
        z = np.array([[np.hypot(*position), np.arctan2(position[1], position[0])]]) + rng.normal(0.0, [3.0, 0.01])
        told, got = filter.step(told, z, sensor=sensor, noise=large[None])
        wanted_state, wanted = reference.step(wanted_state, z, sensor=changed)
        # The excess at a birth's place is linearized; all else is the same.
        assert_equal(got, wanted, 0.05 if form == "places" else 1e-7)
    assert len(got.labels) == 1


def test_each_of_two_targets_is_corrected_by_the_noise_of_its_own_measurement():
    rng = np.random.default_rng(3)
    F, Q, H = PLANE.transition, PLANE.process_noise, PLANE.observation
    means = np.array([[0.0, 5.0, 0.0, -3.0], [1e5, 2.0, 0.0, 3.0]])
    P0 = np.diag([100.0, 25.0, 100.0, 25.0])
    options = {"clutter_intensity": 1e-12, "detection": 0.99, "survival": 1.0, "reduction": UNMERGED}
    filter = PMB(PLANE, Birth([0.1, 0.1], means, P0), **options)
    x, P = means.copy(), np.stack([P0, P0])
    state = filter.initial(np.zeros((0, 2)))
    for k in range(8):
        z = means[:, [0, 2]] + k * means[:, [1, 3]] + rng.normal(0.0, 2.0, (2, 2))
        noise = np.stack([np.diag(rng.uniform(0.1, 50.0, 2)) for _ in range(2)])
        state, estimate = filter.step(state, z, noise=noise)
        for i in range(2):
            if k:
                x[i], P[i] = F @ x[i], F @ P[i] @ F.T + Q
            K = P[i] @ H.T @ np.linalg.inv(H @ P[i] @ H.T + noise[i])
            x[i], P[i] = x[i] + K @ (z[i] - H @ x[i]), P[i] - K @ H @ P[i]
    order = np.argsort(estimate.states[:, 0])
    np.testing.assert_allclose(estimate.states[order], x, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(estimate.covariances[order], P, rtol=1e-8, atol=1e-8)


def test_smoothed_states_are_those_of_two_passes_with_the_same_noises():
    rng = np.random.default_rng(4)
    F, Q, H = PLANE.transition, PLANE.process_noise, PLANE.observation
    x, P = np.array([0.0, 5.0, 0.0, -3.0]), np.diag([100.0, 25.0, 100.0, 25.0])
    options = {"clutter_intensity": 1e-9, "detection": 0.6, "survival": 0.999, "reduction": UNMERGED}
    filter = TrajectoryPMB(PLANE, Birth([0.03], [x], P), lag=5, **options)
    state = filter.initial(np.zeros((0, 2)))
    filtered, predicted = [], []
    for k in range(9):
        z, R = np.array([[5.0 * k, -3.0 * k]]) + rng.normal(0.0, 2.0, 2), np.diag(rng.uniform(0.1, 30.0, 2))
        state, estimate = filter.step(state, z, noise=R[None])
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        predicted.append((x, P))
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z[0] - H @ x), P - K @ H @ P
        filtered.append((x, P))
    for k in range(7, 2, -1):
        G = filtered[k][1] @ F.T @ np.linalg.inv(predicted[k + 1][1])
        x, P = filtered[k][0] + G @ (x - predicted[k + 1][0]), filtered[k][1] + G @ (P - predicted[k + 1][1]) @ G.T
    np.testing.assert_allclose(estimate.states[0], x, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(estimate.covariances[0], P, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kind", [PMB, GMPHD, GlobalNearestNeighbor])
def test_noise_follows_its_measurement_through_a_batch_with_gaps(kind):
    filter, rng = make(kind), np.random.default_rng(5)
    scans = scene(100_002)
    single = filter.initial(scans[0])
    batch = filter.initial(np.zeros((2, 12, 3)))
    for z in scans:
        root = rng.normal(0.0, 2.0, (len(z), 2, 2))
        noise = root @ np.swapaxes(root, 1, 2) + 0.2 * np.eye(2)
        rows, spread = np.zeros((2, 12, 3)), np.full((2, 12, 2, 2), np.nan)
        places = np.sort(rng.permutation(12)[: len(z)])
        rows[1, places, 0], rows[1, places, 1:], spread[1, places] = 1.0, z, noise
        single, wanted = filter.step(single, z, noise=noise)
        batch, got = filter.step(batch, rows, noise=spread)
        shown = got.labels[1] > 0
        np.testing.assert_array_equal(got.labels[1][shown], wanted.labels)
        np.testing.assert_array_equal(got.states[1][shown], wanted.states)


def test_a_late_scan_keeps_its_noise():
    rng = np.random.default_rng(6)
    scans = [(0.7 * k, z, np.stack([np.diag(rng.uniform(0.2, 20.0, 2)) for _ in z])) for k, z in enumerate(scene(1, 6))]
    ordered, late = TimedTracker(make(PMB)), TimedTracker(make(PMB))
    for time, z, noise in scans:
        wanted = ordered.update(z, time, noise=noise)
    for k in (1, 0, 3, 2, 5, 4):
        got = late.update(scans[k][1], scans[k][0], noise=scans[k][2])
    np.testing.assert_array_equal(got.states, wanted.states)


def test_bad_noises_are_refused_by_name():
    filter = make(PMB)
    z = np.array([[0.0, 0.0], [5.0, 5.0]])
    state, fine = filter.initial(z), np.broadcast_to(OTHER, (2, 2, 2))
    for noise, message in (
        (OTHER, r"noise must have shape \(2, 2, 2\), one covariance per measurement, got \(2, 2\)"),
        (fine[:1], r"noise must have shape \(2, 2, 2\)"),
        (fine * np.nan, "noise must be finite"),
        (np.stack([OTHER, -OTHER]), r"noise must be positive definite, .* for measurement 1"),
        (0.0 * fine, "noise must be positive definite"),
        (fine * [[1.0, 2.0], [1.0, 1.0]], "noise must be symmetric"),
        ("exact", "noise must be"),
    ):
        with pytest.raises(ValueError, match=message):
            filter.step(state, z, noise=noise)
    filter.step(state, np.zeros((0, 2)), noise=np.zeros((0, 2, 2)))
    filter.step(state, [], noise=[])
    pairwise = make(PMB, pairwise_structure(PLANE, "S1"))
    with pytest.raises(ValueError, match="noise must be None under a pairwise Markov model"):
        pairwise.step(pairwise.initial(z), z, noise=fine)


def test_a_function_sensor_without_places_starts_nothing():
    sensor = FunctionSensor(lambda x: x[:, [0, 2]], np.eye(2))
    filter = make(PMB)
    z = np.array([[3.0, 4.0]])
    state, estimate = filter.step(filter.initial(z, sensor), z, sensor=sensor, noise=OTHER[None])
    assert len(estimate.labels) == 0
    assert not (state.births.weight > 0.0).any()


@pytest.mark.parametrize("kind", [kind for kind in GAUSSIAN if kind is not TrajectoryPMB])
@pytest.mark.parametrize("sensor", [None, range_bearing_sensor(2.0, 0.01)], ids=["linear", "polar"])
def test_names_of_measurements_reach_the_targets_that_they_belong_to(kind, sensor):
    filter, rng = make(kind), np.random.default_rng(100_003)
    state = filter.initial(np.zeros((0, 2)), sensor)
    correct, seen = 0, 0
    for k in range(25):
        true = np.array([[100.0 + 10.0 * k, 60.0], [100.0 + 10.0 * k, -60.0], [400.0, 10.0 * k]])
        names = np.array(["A", "B", "C"] + ["clutter"] * 5)
        places = np.vstack([true + rng.normal(0.0, 1.5, (3, 2)), rng.uniform(-500.0, 500.0, (5, 2))])
        z = places if sensor is None else np.c_[np.hypot(*places.T), np.arctan2(places[:, 1], places[:, 0])]
        order = rng.permutation(8)[2:]
        z, names = z[order], names[order]
        state, estimate = filter.step(state, z, sensor=sensor)
        found = match_measurements(estimate, z, PLANE, sensor=sensor)
        used = found[found >= 0]
        assert len(set(used.tolist())) == len(used)
        for target, row in zip(estimate.states, found, strict=True):
            distance = np.linalg.norm(true - target[[0, 2]], axis=1)
            name = "ABC"[int(distance.argmin())]
            if k >= 5 and distance.min() < 10.0 and name in names:
                seen += 1
                correct += row >= 0 and names[row] == name
    assert seen > 20
    assert correct >= 0.95 * seen


def test_matching_refuses_batches_and_other_scans():
    filter = make(PMB)
    z = np.zeros((1, 2))
    _, estimate = filter.step(filter.initial(z), z)
    with pytest.raises(ValueError, match=r"measurements must have shape \(number, 2\)"):
        match_measurements(estimate, np.zeros((1, 3)), PLANE)
    with pytest.raises(ValueError, match="gate_probability must be in"):
        match_measurements(estimate, z, PLANE, gate_probability=1.0)
    with pytest.raises(ValueError, match="measurement must be a scan of one run"):
        match_measurements(estimate, np.zeros((1, 2, 3)), PLANE)
    rows = np.zeros((1, 2, 3))
    _, batch = filter.step(filter.initial(rows), rows)
    with pytest.raises(ValueError, match="estimate must be of one run"):
        match_measurements(batch, z, PLANE)
    assert match_measurements(estimate, np.zeros((0, 2)), PLANE).shape == estimate.labels.shape
