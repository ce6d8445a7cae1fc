"""Scans at varying intervals, of several sensors, and out of order."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec

from servotrack.estimators.rfs import (
    GMPHD,
    LMB,
    PMB,
    PMBM,
    Birth,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    FunctionSensor,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    HiddenMarkovModel,
    LinearSensor,
    MeasurementBirth,
    RangeBearingModel,
    RobustPMB,
    TimedTracker,
    TrajectoryPMB,
    bearing_sensor,
    constant_velocity,
    maneuvers,
    pairwise_structure,
    range_bearing_sensor,
    spherical_sensor,
)
from servotrack.estimators.testing.bits import first_difference
from servotrack.estimators.testing.values import flat

FILTERS = [GMPHD, GMCBMeMBer, LMB, PMB, PMBM]
KAPPA = 20.0 / 4000.0**2
PLANE = constant_velocity(5.0, 1.5)


def births(kind=MeasurementBirth):
    if kind is MeasurementBirth:
        return MeasurementBirth(0.1, 10.0)
    return Birth([0.05], np.zeros((1, 4)), np.diag([100.0, 25.0, 100.0, 25.0]))


def walk(model, intervals, seed, *, clutter=20, start=None):
    """Times and scans of one target in clutter: positions with 1.5 m noise, the target's measurement first."""
    rng = np.random.default_rng(seed)
    x = np.array([0.0, 20.0, 0.0, -10.0]) if start is None else np.array(start)
    time, scans, path = 0.0, [], []
    for dt in intervals:
        F, Q = model.motion(dt)
        x = F @ x + np.linalg.cholesky(Q) @ rng.standard_normal(len(x))
        time += dt
        z = model.observation @ x + 1.5 * rng.standard_normal(2)
        scans.append((time, np.vstack([z, rng.uniform(-2000.0, 2000.0, (rng.poisson(clutter), 2))])))
        path.append(x)
    return scans, np.array(path)


@pytest.mark.parametrize(
    "motion",
    [
        ConstantVelocity(2.0),
        ConstantVelocity(2.0, 3),
        ConstantAcceleration(0.5),
        CoordinatedTurn(2.0, 0.0),
        CoordinatedTurn(2.0, 1e-4),
        CoordinatedTurn(2.0, 0.033),
        CoordinatedTurn(2.0, -0.7),
    ],
)
def test_two_short_steps_of_a_motion_are_one_long_step(motion):
    (F1, Q1), (F2, Q2), (F, Q) = motion(1.0), motion(2.5), motion(3.5)
    np.testing.assert_allclose(F2 @ F1, F, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("rate", [0.01, 0.04, 0.3, -1.0])
def test_noise_of_a_turn_is_the_integral_of_its_transition(rate):
    motion = CoordinatedTurn(1.0, rate)
    pushed = np.zeros((4, 2))
    pushed[1, 0] = pushed[3, 1] = 1.0

    def density(s):
        moved = motion(s)[0] @ pushed
        return moved @ moved.T

    expected = quad_vec(density, 0.0, 3.0, epsabs=1e-13)[0]
    np.testing.assert_allclose(motion(3.0)[1], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("structure", ["S1", "S2", "S6"])
@pytest.mark.parametrize("dt", [0.01, 0.5, 3.0, 60.0])
def test_pairwise_model_of_another_interval_keeps_the_hidden_one_and_its_correlation(structure, dt):
    pairwise = pairwise_structure(PLANE, structure)
    other, hidden = pairwise.at(dt), PLANE.at(dt)
    H, R = hidden.observation, hidden.measurement_noise
    # The marginals of a hidden Markov model: x' from x alone if y = H x + v is integrated out.
    B, n = other.transition, 4
    np.testing.assert_allclose(B[:n, :n] + B[:n, n:] @ H, hidden.transition, atol=1e-9)
    noise = other.noise[:n, :n] + B[:n, n:] @ R @ B[:n, n:].T
    np.testing.assert_allclose(noise, hidden.process_noise, rtol=1e-9, atol=1e-9)

    def correlation(model, at):
        return np.linalg.solve(np.linalg.cholesky(at.process_noise), model.transition[:n, n:])

    np.testing.assert_allclose(correlation(other, hidden), correlation(pairwise, PLANE), atol=1e-9)
    assert other.at(1.0).transition == pytest.approx(pairwise.transition, abs=1e-12)


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("model", [PLANE, pairwise_structure(PLANE, "S1")], ids=["hidden", "pairwise"])
@pytest.mark.parametrize("birth", [MeasurementBirth, Birth])
def test_alternating_intervals_equal_a_filter_whose_matrices_are_exchanged_by_hand(kind, model, birth):
    intervals = [1.0, 10.0] * 6
    scans, _ = walk(PLANE, intervals, 100_000)
    options = {"clutter_intensity": KAPPA, "detection": 0.95}
    timed = kind(model, births(birth), **options)
    state = timed.initial(scans[0][1])
    by_hand = state
    for dt, (_, z) in zip(intervals, scans, strict=True):
        state, estimate = timed.step(state, z, dt)
        chance = births(birth)
        more = {"weights": dt * chance.weights} if birth is Birth else {"expected": dt * chance.expected}
        chance = replace(chance, **more)
        exchanged = kind(replace(model.at(dt), period=1.0), chance, survival=0.99**dt, **options)
        by_hand, expected = exchanged.step(by_hand, z)
        np.testing.assert_array_equal(estimate.labels, expected.labels)
        np.testing.assert_allclose(estimate.states, expected.states, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(estimate.existence, expected.existence, atol=1e-12)


def test_target_is_found_at_the_next_scans_when_intervals_alternate():
    # Births at the scan before a long interval must be predicted over that interval, not over the last one.
    found = np.zeros(3)
    runs = 40
    for seed in range(100_000, 100_000 + runs):
        intervals = [1.0, 10.0, 1.0, 10.0, 1.0]
        # Little clutter: after 10 s a target may be 100 m away, where more of it would be mistaken for it.
        scans, path = walk(PLANE, intervals, seed, clutter=1)
        filter = PMB(PLANE, MeasurementBirth(0.5, 30.0, largest=0.5), clutter_intensity=0.05 * KAPPA)
        state = filter.initial(scans[0][1])
        for k, (dt, (_, z)) in enumerate(zip(intervals, scans, strict=True)):
            if k == 0:
                z = z[1:]
            state, estimate = filter.step(state, z, dt)
            if k >= 2:
                away = np.hypot(*(estimate.states[:, [0, 2]] - path[k, [0, 2]]).T) if len(estimate.states) else [1e9]
                found[k - 2] += np.min(away) < 6.0
    assert np.all(found == runs), found


def test_one_period_by_name_is_the_same_filter():
    filter = PMB(PLANE, births(), clutter_intensity=KAPPA)
    assert filter.at() is filter
    assert filter.at(1.0) is filter
    assert filter.at(2.0) is filter.at(2.0)
    pickle.loads(pickle.dumps(filter))


@pytest.mark.parametrize("kind", [*FILTERS, GlobalNearestNeighbor])
def test_function_sensor_equals_the_compiled_one(kind):
    R = np.diag([25.0, 0.005**2])
    own = RangeBearingModel(PLANE.transition, PLANE.process_noise, PLANE.observation, R, (0.0, -50.0))
    sensor = range_bearing_sensor(5.0, 0.005, at=(0.0, -50.0))
    if kind is GlobalNearestNeighbor:
        compiled, called = kind(own), kind(PLANE)
    else:
        compiled, called = (kind(one, births(), clutter_intensity=1e-3, detection=0.9) for one in (own, PLANE))
    rng = np.random.default_rng(100_000)
    x = np.array([300.0, 3.0, 200.0, 4.0])
    a, b = compiled.initial(np.zeros((0, 2))), called.initial(np.zeros((0, 2)), sensor)
    for _ in range(15):
        x = PLANE.transition @ x
        z = sensor.function(x[None]) + [5.0, 0.005] * rng.standard_normal(2)
        z = np.vstack([z, np.column_stack([rng.uniform(0.0, 800.0, 5), rng.uniform(-3.1, 3.1, 5)])])
        a, first = compiled.step(a, z)
        b, second = called.step(b, z, sensor=sensor)
        np.testing.assert_array_equal(first.labels, second.labels)
        np.testing.assert_allclose(first.states, second.states, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", FILTERS)
def test_linear_sensor_equals_its_model(kind):
    sharp = constant_velocity(5.0, 0.3)
    sensor = LinearSensor(sharp.observation, sharp.measurement_noise, detection=0.7, clutter_intensity=2 * KAPPA)
    asked = kind(PLANE, births(), clutter_intensity=KAPPA, detection=0.95)
    direct = kind(sharp, births(), clutter_intensity=2 * KAPPA, detection=0.7)
    scans, _ = walk(PLANE, [1.0] * 8, 100_000)
    a, b = asked.initial(scans[0][1]), direct.initial(scans[0][1])
    for _, z in scans:
        a, first = asked.step(a, z, sensor=sensor)
        b, second = direct.step(b, z)
        np.testing.assert_array_equal(first.states, second.states)
        np.testing.assert_array_equal(first.existence, second.existence)


def test_jacobian_of_a_linear_function_is_the_kalman_filter():
    H, R = PLANE.observation, PLANE.measurement_noise
    linear = LinearSensor(H, R)
    options = {"position": (0, 2), "places": None}
    with_slope = FunctionSensor(lambda x: x @ H.T, R, jacobian=lambda x: np.broadcast_to(H, (len(x), 2, 4)), **options)
    unscented = FunctionSensor(lambda x: x @ H.T, R, **options)
    filter = PMB(PLANE, births(Birth), clutter_intensity=KAPPA)
    scans, _ = walk(PLANE, [1.0] * 6, 100_001)
    states = [filter.initial(scans[0][1])] * 3
    for _, z in scans:
        results = [
            filter.step(s, z, sensor=one) for s, one in zip(states, (linear, with_slope, unscented), strict=True)
        ]
        states = [state for state, _ in results]
        for _, estimate in results[1:]:
            np.testing.assert_allclose(estimate.states, results[0][1].states, rtol=1e-8, atol=1e-7)


def test_two_sensors_at_one_instant_are_nearly_the_same_in_either_order():
    # x alone and y alone: other sizes than the model's own measurement.
    first = LinearSensor(PLANE.observation[:1], [[1.0]], clutter_intensity=1.0 / 4000.0)
    second = LinearSensor(PLANE.observation[1:], [[1.0]], clutter_intensity=1.0 / 4000.0)
    filter = PMB(PLANE, births(Birth), clutter_intensity=KAPPA, detection=0.95)
    scans, path = walk(PLANE, [1.0] * 12, 100_000, clutter=0, start=[0.0, 2.0, 0.0, -1.0])
    ends = []
    for order in ((0, 1), (1, 0)):
        state = filter.initial(np.zeros((0, 1)), first)
        for _, z in scans:
            for place, axis in enumerate(order):
                dt = 1.0 if place == 0 else 0.0
                state, estimate = filter.step(state, z[:1, axis : axis + 1], dt, (first, second)[axis])
        ends.append(estimate)
        assert len(estimate.states) == 1
        assert np.hypot(*(estimate.states[0, [0, 2]] - path[-1, [0, 2]])) < 6.0
    np.testing.assert_allclose(ends[0].states, ends[1].states, atol=0.05)


def test_nothing_moves_appears_or_vanishes_between_scans_of_one_instant():
    filter = PMB(PLANE, births(Birth), clutter_intensity=KAPPA, detection=0.0, survival=0.5)
    state = filter.initial(np.zeros((0, 2)))
    for _ in range(3):
        state, before = filter.step(state, np.zeros((0, 2)))
    again, after = filter.step(state, np.zeros((0, 2)), 0.0)
    assert after.expected_number == pytest.approx(before.expected_number, abs=1e-15)
    np.testing.assert_array_equal(again.undetected.mean[..., :4], state.undetected.mean[..., :4])


@pytest.mark.parametrize("kind", FILTERS)
def test_radar_with_range_rate_tracks_in_three_dimensions(kind):
    model = constant_velocity(2.0, 1.0, dimensions=3)
    sensor = spherical_sensor(0.005, 0.005, 5.0, 1.0, at=(10.0, 20.0, 0.0), clutter_intensity=1e-6)
    tracker = TimedTracker(kind(model, MeasurementBirth(0.1, 20.0), clutter_intensity=1.0, detection=0.9))
    rng = np.random.default_rng(100_000)
    x, time = np.array([300.0, 30.0, 200.0, 40.0, 500.0, -10.0]), 0.0
    for _ in range(25):
        dt = rng.uniform(0.2, 3.0)
        F, Q = model.motion(dt)
        x, time = F @ x + np.linalg.cholesky(Q) @ rng.standard_normal(6), time + dt
        z = sensor.function(x[None]) + [0.005, 0.005, 5.0, 1.0] * rng.standard_normal(4)
        low, high = [-3.0, -1.0, 0.0, -60.0], [3.0, 1.0, 4000.0, 60.0]
        estimate = tracker.update(np.vstack([z, rng.uniform(low, high, (10, 4))]), time, sensor)
    assert len(estimate.states) == 1
    assert np.linalg.norm(estimate.states[0, [0, 2, 4]] - x[[0, 2, 4]]) < 40.0
    assert np.linalg.norm(estimate.states[0, [1, 3, 5]] - x[[1, 3, 5]]) < 8.0


def test_bearings_from_a_moving_ship_find_the_range():
    model = constant_velocity(0.05, 1.0)
    rng = np.random.default_rng(100_000)
    tracker = TimedTracker(PMB(model, MeasurementBirth(0.2, 3.0), clutter_intensity=1.0, detection=0.95))
    x = np.array([4000.0, -3.0, 3000.0, 1.0])
    for k in range(120):
        time = 10.0 * k
        # The ship zigzags, without which the range of a target in steady motion cannot be seen.
        ship = np.array([6.0 * time, 800.0 * np.sin(time / 150.0)])
        target = x + np.array([time * x[1], 0.0, time * x[3], 0.0])
        sensor = bearing_sensor(0.01, at=ship, distances=(500.0, 20_000.0), clutter_intensity=2.0 / (2.0 * np.pi))
        z = sensor.function(target[None]) + 0.01 * rng.standard_normal(1)
        clutter = rng.uniform(-np.pi, np.pi, (rng.poisson(2.0), 1))
        estimate = tracker.update(np.vstack([z, clutter]), time, sensor)
    assert len(estimate.states) == 1
    distance = np.hypot(*(target[[0, 2]] - ship))
    assert np.hypot(*(estimate.states[0, [0, 2]] - target[[0, 2]])) < 0.1 * distance


@pytest.mark.parametrize("kind", [PMB, GMPHD, GlobalNearestNeighbor])
def test_late_scans_end_in_the_state_of_scans_in_order(kind):
    filter = kind(PLANE) if kind is GlobalNearestNeighbor else kind(PLANE, births(), clutter_intensity=KAPPA)
    scans, _ = walk(PLANE, [0.5, 1.0, 2.0, 0.3, 4.0, 1.0, 1.0], 100_002)
    ordered, late = TimedTracker(filter), TimedTracker(filter)
    for time, z in scans:
        expected = ordered.update(z, time)
    for k in (2, 0, 1, 4, 3, 6, 5):
        estimate = late.update(scans[k][1], scans[k][0])
    np.testing.assert_array_equal(estimate.states, expected.states)
    np.testing.assert_array_equal(estimate.labels, expected.labels)
    assert late.time == scans[-1][0]


def test_scan_before_the_memory_is_refused_and_changes_nothing():
    tracker = TimedTracker(PMB(PLANE, births(), clutter_intensity=KAPPA), memory=3.0)
    scans, _ = walk(PLANE, [1.0] * 8, 100_000)
    for time, z in scans:
        tracker.update(z, time)
    before = tracker.estimate
    with pytest.raises(ValueError, match=r"time must be at least 4\.0, .* got 2\.5; raise memory"):
        tracker.update(scans[0][1], 2.5)
    with pytest.raises(ValueError, match="measurements must have shape"):
        tracker.update(np.zeros((1, 3)), 9.0)
    for time in (np.nan, 1e300, None, "9", np.ones(2)):
        with pytest.raises(ValueError, match="time must be finite"):
            tracker.update(scans[0][1], time)
    assert tracker.estimate is before
    assert tracker.time == 8.0
    tracker.update(scans[4][1], 4.5)
    tracker.reset()
    tracker.update(scans[0][1], 0.0)


RETURNED = {
    "text": (lambda x: np.full((len(x), 1), "1"), "must be real numbers, got text"),
    "complex": (lambda x: np.ones((len(x), 1)) * 1j, "must be real numbers, got complex"),
    "objects": (lambda x: np.full((len(x), 1), None), "must be real numbers, got objects"),
    "masked": (lambda x: np.ma.masked_array(np.ones((len(x), 1)), True), "must not have masked entries"),
    "ragged": (lambda x: [*[[1.0]] * (len(x) - 1), [1.0, 2.0]], "must be an array of numbers|must return shape"),
    "NaN": (lambda x: np.full((len(x), 1), np.nan), "must return finite values"),
    "shape": (lambda x: np.zeros((len(x), 3)), r"must return shape \(\d+,"),
}


def distance(x):
    return np.hypot(x[:, 0], x[:, 2])[:, None]


@pytest.mark.parametrize("argument", ["function", "jacobian", "places", "detection", "clutter_intensity"])
@pytest.mark.parametrize("kind", RETURNED)
def test_what_functions_of_a_sensor_return_is_checked(kind, argument):
    function, message = RETURNED[kind]

    def given(x):
        values = function(x)
        if kind not in ("ragged", "shape"):
            wide = np.ma.repeat(values[:, None], 2 if argument == "places" else 4, axis=2)
            values = {"function": values, "jacobian": wide, "places": wide}.get(argument, values[:, 0])
        return (values, np.ones((len(x), 1, 2, 2))) if argument == "places" else values

    sensor = FunctionSensor(**({"function": distance, "noise": np.eye(1)} | {argument: given}))
    filter = GMPHD(PLANE, births() if argument == "places" else births(Birth), clutter_intensity=KAPPA)
    z = np.full((2, 1), 5.0)
    with pytest.raises(ValueError, match=message):
        filter.step(filter.initial(z, sensor), z, 1.0, sensor)


@pytest.mark.parametrize("kind", [GMPHD, PMB])
def test_functions_of_a_sensor_may_write_into_their_arguments(kind):
    def spoiling(function):
        def call(x):
            found = function(x)
            x[...] = 0.0
            return found

        return call

    def slope(x):
        H = np.zeros((len(x), 1, 4))
        H[:, 0, [0, 2]] = x[:, [0, 2]] / np.maximum(distance(x), 1.0)
        return H

    def places(z):
        return np.repeat(z[:, None], 2, axis=2), np.tile(100.0 * np.eye(2), (len(z), 1, 1, 1))

    results = []
    for change in (lambda one: one, spoiling):
        sensor = FunctionSensor(change(distance), np.eye(1), jacobian=change(slope), places=change(places))
        filter = kind(PLANE, births(), clutter_intensity=KAPPA)
        scans = [np.array([[50.0], [80.0]]) + k for k in range(4)]
        state = filter.initial(scans[0], sensor)
        for z in scans:
            state, estimate = filter.step(state, z, 1.0, sensor)
        results.append((state, estimate, scans))
    assert first_difference(*map(flat, results), "result") is None


def test_places_of_a_sensor_need_covariances():
    for covariance in (np.diag([1.0, -1.0]), np.array([[1.0, 0.5], [0.0, 1.0]])):
        sensor = FunctionSensor(
            distance,
            np.eye(1),
            places=lambda z, P=covariance: (np.zeros((len(z), 1, 2)), np.tile(P, (len(z), 1, 1, 1))),
        )
        filter = PMB(PLANE, births(), clutter_intensity=KAPPA)
        with pytest.raises(ValueError, match="places must return symmetric positive semidefinite covariances"):
            filter.step(filter.initial(np.ones((1, 1)), sensor), np.ones((1, 1)), 1.0, sensor)


def test_modes_stay_probabilities_over_long_intervals():
    filter = RobustPMB(PLANE, births(), clutter_intensity=KAPPA, volume=1.0 / KAPPA, modes=maneuvers(PLANE))
    state = filter.initial(np.zeros((1, 2)))
    for dt in (1e10, 1.0, 1e9):
        state, estimate = filter.step(state, np.zeros((1, 2)), dt)
        assert np.isfinite(estimate.expected_number)


def test_bad_intervals_and_sensors_are_refused_by_name():
    filter = PMB(PLANE, births(), clutter_intensity=KAPPA)
    state, z = filter.initial(np.zeros((0, 2))), np.zeros((1, 2))
    for dt in (-1.0, np.nan, np.inf, 1e300, "1", np.ones(2), 1j):
        with pytest.raises(ValueError, match=r"dt must be finite and >= 0, .*, got .*TimedTracker"):
            filter.step(state, z, dt)
    fixed = HiddenMarkovModel(PLANE.transition, PLANE.process_noise, PLANE.observation, PLANE.measurement_noise)
    with pytest.raises(ValueError, match=r"dt must be the model's period, 1 s, or 0, got 2\.0: .* motion="):
        PMB(fixed, births(), clutter_intensity=KAPPA).step(state, z, 2.0)
    pairwise = PMB(pairwise_structure(PLANE, "S1"), births(), clutter_intensity=KAPPA)
    with pytest.raises(ValueError, match="sensor must be None under a pairwise"):
        pairwise.step(pairwise.initial(z), z, sensor=LinearSensor(PLANE.observation, np.eye(2)))
    with pytest.raises(ValueError, match="dt must be > 0 under a pairwise"):
        pairwise.step(pairwise.initial(z), z, 0.0)
    with pytest.raises(ValueError, match="sensor must be a LinearSensor or a FunctionSensor, got str"):
        filter.step(state, z, sensor="radar")
    with pytest.raises(ValueError, match=r"observation must be a matrix of shape \('any', 4\), got shape \(2, 3\)"):
        filter.step(state, z, sensor=LinearSensor(np.zeros((2, 3)), np.eye(2)))
    with pytest.raises(ValueError, match=r"sensor position must be indices of the 4 state entries, got \(0, 7\)"):
        filter.step(state, z, sensor=range_bearing_sensor(1.0, 0.1, position=(0, 7)))
    with pytest.raises(ValueError, match=r"sensor function must return shape \(\d+, 2\), got"):
        broken = FunctionSensor(lambda x: x, np.eye(2))
        sites = PMB(PLANE, births(Birth), clutter_intensity=KAPPA)
        sites.step(sites.initial(z), z, sensor=broken)
    with pytest.raises(ValueError, match="sensor function must return finite values"):
        blind = FunctionSensor(lambda x: np.full((len(x), 2), np.nan), np.eye(2))
        sites.step(sites.initial(z), z, sensor=blind)
    with pytest.raises(ValueError, match="distances must be"):
        bearing_sensor(0.1, distances=(5.0, 1.0))
    with pytest.raises(ValueError, match="bearing_deviation must be finite and > 0, got 0"):
        bearing_sensor(0)
    with pytest.raises(ValueError, match="sensor must have places= to start a track"):
        nearest = GlobalNearestNeighbor(PLANE)
        nearest.step(
            nearest.initial(np.zeros((1, 1)), bearing_sensor(0.1)), np.zeros((1, 1)), sensor=bearing_sensor(0.1)
        )


@pytest.mark.parametrize("kind", FILTERS)
def test_batches_of_runs_take_intervals_and_sensors(kind):
    filter = kind(PLANE, births(), clutter_intensity=1e-3)
    sensor = range_bearing_sensor(5.0, 0.01, 1.0)
    rng = np.random.default_rng(100_000)
    z = rng.uniform([0.0, -3.0, -5.0], [500.0, 3.0, 5.0], (3, 2, 4, 3))
    rows = np.concatenate([np.ones((3, 2, 4, 1)), z], axis=-1)
    batch = filter.initial(rows[0], sensor)
    single = filter.initial(z[0, 1], sensor)
    for k, dt in enumerate((1.0, 0.25, 0.0)):
        batch, many = filter.step(batch, rows[k], dt, sensor)
        single, one = filter.step(single, z[k, 1], dt, sensor)
        known = many.labels[1] > 0
        np.testing.assert_array_equal(many.states[1][known], one.states)
        assert many.expected_number[1] == one.expected_number


@pytest.mark.parametrize(
    ("kind", "name", "values"),
    [
        (PMB, "survival", ("1", None, np.nan, 1.5, [1.0])),
        (PMB, "clutter_intensity", ("1", None, np.inf, -1.0)),
        (PMB, "gate_probability", ("1", 0.0, [0.99])),
        (PMB, "variants", (0, 1.5, True, None)),
        (PMB, "undetected", (0, 1.5, np.nan, True, "9")),
        (PMB, "reduction", (None, 100)),
        (PMBM, "assignments", (0, np.nan, np.inf, 1.5, True)),
        (PMBM, "recycle", (1.0, np.nan, "0")),
        (TrajectoryPMB, "lag", (-1, 1.5, np.nan, True, None)),
    ],
)
def test_wrong_arguments_of_filters_are_refused_by_name(kind, name, values):
    for value in values:
        with pytest.raises(ValueError, match=f"^{name} must be"):
            kind(PLANE, births(), **({"clutter_intensity": KAPPA} | {name: value}))
