"""The adaptive PMB: births that add, sensor parameters estimated online, motion modes, and arrays that grow."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    PMBM,
    Birth,
    Births,
    GlobalNearestNeighbor,
    GMCBMeMBer,
    InteractingModels,
    LinearSensor,
    MeasurementBirth,
    Reduction,
    RegionSurvival,
    RobustPMB,
    SensorAdaptation,
    TrajectoryPMB,
    constant_acceleration,
    constant_velocity,
    coordinated_turn,
    lasting,
    maneuvers,
    pairwise_structure,
    white_acceleration,
)
from servotrack.estimators.rfs.interacting import _stationary, hidden_motion, with_motion
from servotrack.estimators.rfs.pmb_kernel import Tally
from servotrack.estimators.stateful import Stateful, select_rows

SEED = 100_000
HMM = constant_velocity(5.0, 1.5)
PMM = pairwise_structure(HMM, "S1")
AREA = 4000.0**2
SITES = Birth([0.05, 0.05], np.array([[0.0, 0.0, 0.0, 0.0], [400.0, 0.0, 0.0, 0.0]]), 100.0 * np.eye(4))


def scene(level, seed=SEED, **axes):
    config = clutter_config(level, **axes)
    return scene_model_of(config), draw_episode(config, seed)


def used(rows):
    return rows[rows[:, 0] == 1.0, 1:]


def births_of(hint):
    if hint.birth_means is None:
        return MeasurementBirth(float(hint.birth_weights.sum()), np.sqrt(np.diag(hint.birth_covariance)))
    return Birth(hint.birth_weights, hint.birth_means, hint.birth_covariance)


# Births


def test_intensities_of_births_add():
    both = Births(SITES, MeasurementBirth(0.02, 10.0, largest=0.02))
    filter_ = PMB(HMM, both, clutter_intensity=1e-6, detection=0.9, survival=1.0)
    z = np.array([[900.0, 900.0], [-900.0, 500.0]])
    state, estimate = filter_.step(filter_.initial(z), z)
    assert estimate.expected_number == pytest.approx(0.1 * 0.1, rel=1e-6)  # undetected targets of the sites alone
    assert state.births.weight.sum() == pytest.approx(0.02)
    _, estimate = filter_.step(state, z[:0])
    assert estimate.expected_number == pytest.approx(0.1 * (0.1 * 0.1 + 0.12), rel=1e-3)


def test_expected_number_of_a_filter_that_hardly_sees_is_that_of_the_scene():
    # .5 births a scan that live 20 scans on average and are detected with probability .3: 8.0 at scan 30.
    survival, rate, scans, runs = 0.95, 0.5, 30, 200
    true = rate * (1.0 - survival**scans) / (1.0 - survival)
    assert true == pytest.approx(8.0, abs=0.2)
    model = constant_velocity(1.0, 1.5)
    place = Birth([0.9 * rate], np.zeros((1, 4)), np.diag([1e4, 25.0, 1e4, 25.0]))
    births = Births(place, MeasurementBirth(0.1 * rate, 5.0, largest=1.0))
    filter_ = PMB(model, births, clutter_intensity=1e-9, detection=0.3, survival=survival)
    rng = np.random.default_rng(1)
    rows = np.zeros((scans, runs, 40, 3))
    for run in range(runs):
        targets = np.zeros((0, 4))
        for k in range(scans):
            moved = targets @ model.transition.T + rng.multivariate_normal(
                np.zeros(4), model.process_noise, len(targets)
            )
            new = rng.normal(0.0, [100.0, 5.0, 100.0, 5.0], (rng.poisson(rate), 4))
            targets = np.concatenate([moved[rng.random(len(moved)) < survival], new])
            seen = targets[rng.random(len(targets)) < 0.3][:, [0, 2]]
            rows[k, run, : len(seen), 0] = 1.0
            rows[k, run, : len(seen), 1:] = seen + rng.normal(0.0, 1.5, seen.shape)
    state = filter_.initial(rows[0])
    for scan in rows:
        state, estimate = filter_.step(state, scan)
    assert estimate.expected_number.mean() == pytest.approx(true, rel=0.06)


@pytest.mark.parametrize("kind", [GMPHD, GMCBMeMBer, PMB, PMBM])
def test_every_filter_finds_targets_at_sites_and_elsewhere(kind):
    both = Births(SITES, MeasurementBirth(0.05, 10.0, largest=0.05))
    tracker = Stateful(kind(HMM, both, clutter_intensity=1e-6, detection=0.98))
    for k in range(8):
        estimate = tracker.step(np.array([[2.0 * k, 0.0], [-800.0, 5.0 * k]]))
    assert len(estimate.states) == 2


def test_births_refuse_other_types():
    with pytest.raises(ValueError, match="sites must be a Birth, got MeasurementBirth"):
        Births(MeasurementBirth(), MeasurementBirth())
    with pytest.raises(ValueError, match="anywhere must be a MeasurementBirth, got Birth"):
        Births(SITES, SITES)
    wrong = Births(Birth([0.1], np.zeros((1, 2)), np.eye(2)), MeasurementBirth())
    with pytest.raises(ValueError, match="birth means must have 4 entries"):
        PMB(HMM, wrong, clutter_intensity=1e-6)


# Estimates of the sensor


@pytest.mark.parametrize("detection", [0.6, 0.8, 0.98])
@pytest.mark.parametrize(("clutter", "factor"), [(5.0, 2.0), (50.0, 0.5)])
def test_sensor_parameters_are_found_from_values_wrong_by_a_factor_of_two(detection, clutter, factor):
    axes = {"detection_probability": detection, "clutter_rate": clutter, "initial_targets": 8.0}
    hint, _ = scene(1, **axes)
    rows = np.stack([scene(1, SEED + run, **axes)[1].measurements[:60] for run in range(16)])
    for told in (0.5 * detection, min(2.0 * detection, 0.98)):
        filter_ = RobustPMB(
            hint.model, births_of(hint), clutter_intensity=factor * clutter / AREA, volume=AREA, detection=told
        )
        state = filter_.initial(rows[:, 0])
        for k in range(60):
            state, _ = filter_.step(state, rows[:, k])
        # Means over the runs: one run counts some 300 detections.
        error = state.sensor.detection.std() / 4.0
        assert abs(state.sensor.detection.mean() - detection) < 0.03 * detection + error
        assert abs(state.sensor.clutter_rate.mean() - clutter) < 0.1 * clutter


def test_without_clutter_the_rate_falls_to_less_than_one_measurement():
    axes = {"clutter_rate": 0.0, "detection_probability": 0.9}
    hint, _ = scene(1, **axes)
    rows = np.stack([scene(1, SEED + run, **axes)[1].measurements[:60] for run in range(8)])
    filter_ = RobustPMB(hint.model, births_of(hint), clutter_intensity=5.0 / AREA, volume=AREA, detection=0.9)
    state = filter_.initial(rows[:, 0])
    for k in range(60):
        state, _ = filter_.step(state, rows[:, k])
    assert state.sensor.clutter_rate.mean() < 0.4


def chain(events, survival, detection, existence):
    """P(alive and missed at each scan | all events) of one target that exists with a probability, by enumeration."""
    scans = len(events)
    total, missed, found = 0.0, np.zeros(scans), np.zeros(scans)
    for end in range(-1, scans + 1):  # alive up to scan end - 1; -1: it never was
        alive = np.arange(scans) < end
        if end == -1:
            weight = 1.0 - existence
        else:
            weight = existence * survival**end * (1.0 - survival if end < scans else 1.0)
        for k, event in enumerate(events):
            chance = detection if alive[k] else 0.0
            weight *= chance if event else 1.0 - chance
        total += weight
        missed += weight * alive * (1 - np.array(events))
        found += weight * alive * np.array(events)
    return missed / total, found / total


@pytest.mark.parametrize("events", [[1, 0, 1, 0, 0, 1], [1, 1, 0, 0, 0, 0], [0, 1, 1, 1, 0, 0]])
def test_misses_and_deaths_are_told_apart_as_by_enumeration(events):
    survival, detection, start, lag = 0.95, 0.7, 0.9, 6
    adaptation = SensorAdaptation(lag=lag, memory=1e12, scan_trust=1e12)
    state = adaptation.initial(1, 1, 0.5, 1.0)
    r = start
    counted = []
    for event in events:
        before, predicted = np.array([[r]]), np.array([[survival * r]])
        p = survival * r
        r = 1.0 if event else p * (1.0 - detection) / (1.0 - p * detection)
        tally = Tally(np.zeros((1, 0)), np.array([[float(event)]]), np.zeros((1, 1), np.int64), np.zeros((1, 0)))
        state = adaptation.step(state, before, predicted, np.array([[r]]), tally)
        counted.append(p > 0.5)
    missed, found = chain(events, survival, detection, start)
    pending = state.pending[0, 0, : len(events)].sum(axis=-1)[::-1]
    np.testing.assert_allclose(pending[:, 0], missed * counted, atol=1e-12)
    np.testing.assert_allclose(pending[:, 1], found * counted, atol=1e-12)


def test_a_track_that_ends_is_counted_at_once_and_nothing_is_lost():
    adaptation = SensorAdaptation(lag=3)
    state = adaptation.initial(1, 2, 0.9, 1.0)
    tally = Tally(np.zeros((1, 0)), np.array([[1.0, 0.0]]), np.array([[0, -1]]), np.zeros((1, 0)))
    state = adaptation.step(state, np.array([[0.9, 0.0]]), np.array([[0.9, 0.0]]), np.array([[1.0, 0.0]]), tally)
    assert state.pending.sum() == pytest.approx(1.0)
    found = float(state.found[0])
    none = Tally(np.zeros((1, 0)), np.zeros((1, 2)), np.full((1, 2), -1), np.zeros((1, 0)))
    state = adaptation.step(state, np.array([[1.0, 0.0]]), np.array([[0.99, 0.0]]), np.zeros((1, 2)), none)
    assert state.pending.sum() == 0.0 and float(state.found[0]) > 0.9 + found * np.exp(-1.0)


def test_without_targets_the_detection_probability_stays():
    filter_ = RobustPMB(HMM, SITES, clutter_intensity=1e-6, volume=AREA, detection=0.8)
    tracker = Stateful(filter_)
    for _ in range(300):
        tracker.step(np.zeros((0, 2)))
    assert float(tracker.state.sensor.detection) == pytest.approx(0.8, abs=1e-9)


def test_births_at_measurements_that_never_come_are_expected_less():
    sites = Births(SITES, MeasurementBirth(0.05, 10.0, largest=0.05))
    rates = []
    for shift in (0.0, 900.0):
        tracker = Stateful(RobustPMB(HMM, sites, clutter_intensity=1e-6, volume=AREA, detection=0.98))
        for k in range(60):
            # A target is born every ten scans, at a site or elsewhere, and lives for nine of them.
            age, life = k % 10, k // 10
            z = np.array([[shift + 5.0 * age + 150.0 * life * (shift > 0.0), 0.0]])
            tracker.step(z if age < 9 else z[:0])
        rates.append(float(tracker.state.sensor.birth_rate))
    assert rates[0] < 0.03 < 0.08 < rates[1] < 0.13


# Motion modes


@pytest.mark.parametrize("level", [0, 2, 4])
def test_one_mode_gives_the_bits_of_pmb_and_equal_modes_its_values(level):
    hint, episode = scene(level)
    options = {"clutter_intensity": hint.clutter_intensity, "detection": hint.detection_probability}
    fixed = {"volume": AREA, "adaptation": None, **options}
    plain = Stateful(PMB(hint.model, births_of(hint), **options))
    one = Stateful(RobustPMB(hint.model, births_of(hint), **fixed))
    modes = InteractingModels((hint.model,) * 3, lasting([4.0, 6.0, 20.0]))
    three = Stateful(RobustPMB(hint.model, births_of(hint), modes=modes, **fixed))
    for rows in episode.measurements[:50]:
        a, b, c = (tracker.step(used(rows)) for tracker in (plain, one, three))
        for name in ("states", "labels", "existence", "covariances", "expected_number"):
            assert np.array_equal(getattr(a, name), getattr(b, name))
            np.testing.assert_allclose(getattr(a, name), getattr(c, name), rtol=1e-9, atol=1e-9)


def denser_left(z):
    return np.where(z[:, 0] < 0.0, 1.5, 0.5)


def test_clutter_that_is_denser_in_some_places_keeps_its_shape():
    hint, episode = scene(0)
    options = {"detection": hint.detection_probability}
    mean = hint.clutter_intensity
    plain = Stateful(PMB(hint.model, births_of(hint), clutter_intensity=lambda z: mean * denser_left(z), **options))
    fixed = {"volume": AREA, "clutter_intensity": mean, "clutter_density": denser_left, **options}
    kept = Stateful(RobustPMB(hint.model, births_of(hint), adaptation=None, **fixed))
    for rows in episode.measurements[:30]:
        assert np.array_equal(kept.step(used(rows)).states, plain.step(used(rows)).states)
    # The density has a mean of 1, so that the rate means what it meant.
    one = Stateful(RobustPMB(hint.model, births_of(hint), **fixed))
    for rows in episode.measurements:
        one.step(used(rows))
    assert float(one.state.sensor.clutter_rate) == pytest.approx(hint.clutter_rate, rel=0.15)


def reference_imm(models, switching, probability, mean, cov, scans):
    """Blom and Bar-Shalom 1988, one target that is always detected: mode probabilities, mean and covariance."""
    S = len(models)
    means, covs, mu = [mean] * S, [cov] * S, np.array(probability)
    for z in scans:
        ahead = mu @ switching
        mixed = []
        for j in range(S):
            w = mu * switching[:, j] / ahead[j]
            m = sum(w[i] * means[i] for i in range(S))
            P = sum(w[i] * (covs[i] + np.outer(means[i] - m, means[i] - m)) for i in range(S))
            mixed.append((m, P))
        means, covs, likelihood = [], [], np.zeros(S)
        for j, model in enumerate(models):
            F, Q, H, R = model.transition, model.process_noise, model.observation, model.measurement_noise
            m, P = F @ mixed[j][0], F @ mixed[j][1] @ F.T + Q
            S_ = H @ P @ H.T + R
            K, v = P @ H.T @ np.linalg.inv(S_), z - H @ m
            likelihood[j] = np.exp(-0.5 * v @ np.linalg.solve(S_, v)) / np.sqrt(np.linalg.det(2.0 * np.pi * S_))
            means.append(m + K @ v)
            covs.append(P - K @ S_ @ K.T)
        mu = ahead * likelihood
        mu /= mu.sum()
    m = sum(mu[i] * means[i] for i in range(S))
    return mu, m, sum(mu[i] * (covs[i] + np.outer(means[i] - m, means[i] - m)) for i in range(S))


def test_one_target_is_followed_as_by_a_textbook_filter():
    models = (HMM, constant_velocity(15.0, 1.5), coordinated_turn(0.2, 5.0, 1.5))
    switching = lasting([10.0, 5.0, 4.0])
    modes = InteractingModels(models, switching, np.array([0.5, 0.2, 0.3]))
    place = Birth([1.0], np.array([[0.0, 10.0, 0.0, 0.0]]), 25.0 * np.eye(4))
    filter_ = RobustPMB(
        HMM, place, clutter_intensity=0.0, volume=1.0, detection=1.0, survival=1.0, modes=modes, adaptation=None
    )
    angle = 0.2 * np.arange(12)
    scans = np.stack([50.0 * np.sin(angle), 50.0 * (1.0 - np.cos(angle))], axis=1)
    state, _ = filter_.step(filter_.initial(scans[:1]), scans[:1])
    H, R, P = HMM.observation, HMM.measurement_noise, place.covariances[0]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    mean = place.means[0] + K @ (scans[0] - H @ place.means[0])
    mu, mean, cov = reference_imm(models, switching, [0.5, 0.2, 0.3], mean, P - K @ H @ P, scans[1:])
    for z in scans[1:]:
        state, estimate = filter_.step(state, z[None])
    first = int(np.argmax(estimate.existence))
    np.testing.assert_allclose(estimate.states[first], mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(estimate.covariances[first], cov, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(state.pool.weight[:3], mu, rtol=1e-8)


def test_ready_models_compose_over_time():
    for make in (
        lambda t: constant_acceleration(0.7, 1.0, period=t),
        lambda t: coordinated_turn(0.3, 0.7, 1.0, period=t),
    ):
        once, twice = make(1.0), make(2.0)
        np.testing.assert_allclose(once.transition @ once.transition, twice.transition, atol=1e-12)
    once, twice = constant_acceleration(0.7, 1.0), constant_acceleration(0.7, 1.0, period=2.0)
    F = once.transition
    np.testing.assert_allclose(F @ once.process_noise @ F.T + once.process_noise, twice.process_noise, rtol=1e-12)
    np.testing.assert_allclose(coordinated_turn(0.0, 5.0, 1.5).transition, HMM.transition, atol=1e-15)
    speed = coordinated_turn(0.3, 0.7, 1.0).transition @ np.array([0.0, 3.0, 0.0, 4.0])
    assert np.hypot(speed[1], speed[3]) == pytest.approx(5.0)


def test_white_acceleration_is_constant_velocity():
    wide = white_acceleration(5.0, 1.5)
    plain = Stateful(PMB(HMM, SITES, clutter_intensity=1e-6))
    place = np.zeros((2, 6))
    place[:, [0, 1, 3, 4]] = SITES.means
    same = Stateful(PMB(wide, Birth(SITES.weights, place, 100.0 * np.eye(6)), clutter_intensity=1e-6))
    for k in range(6):
        z = np.array([[5.0 * k, 1.0], [400.0, -8.0 * k]])
        a, b = plain.step(z), same.step(z)
        np.testing.assert_allclose(a.states, b.states[:, [0, 1, 3, 4]], rtol=1e-10, atol=1e-10)


def test_modes_of_a_pairwise_model_keep_its_dependence():
    F, Q = hidden_motion(PMM)
    np.testing.assert_allclose(F, HMM.transition, atol=1e-12)
    np.testing.assert_allclose(Q, HMM.process_noise, atol=1e-10)
    same = with_motion(PMM, F, Q)
    np.testing.assert_allclose(same.transition, PMM.transition, atol=1e-10)
    np.testing.assert_allclose(same.noise, PMM.noise, atol=1e-8)


def test_maneuvers_are_followed():
    errors = {}
    rows = np.stack([scene(3, SEED + run)[1].measurements for run in range(6)])
    hint, _ = scene(3)
    for name, modes in {"plain": None, "modes": maneuvers(hint.model)}.items():
        filter_ = RobustPMB(
            hint.model, births_of(hint), clutter_intensity=hint.clutter_intensity, volume=AREA, modes=modes
        )
        state = filter_.initial(rows[:, 0])
        numbers = []
        for k in range(100):
            state, estimate = filter_.step(state, rows[:, k])
            numbers.append((estimate.labels > 0).sum(axis=1))
        truth = np.stack([scene(3, SEED + run)[1].exists[:100].sum(axis=1) for run in range(6)], axis=1)
        errors[name] = np.abs(np.array(numbers) - truth).mean()
    assert errors["modes"] < 0.6 * errors["plain"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: InteractingModels((), np.ones((0, 0))), "models must hold at least one model"),
        (lambda: InteractingModels((HMM, PMM), lasting([5, 5])), "models must share their measurement"),
        (lambda: InteractingModels((HMM, HMM), np.eye(3)), r"switching must have shape \(2, 2\)"),
        (lambda: InteractingModels((HMM, HMM), np.ones((2, 2))), "switching must hold probabilities"),
        (lambda: lasting([0.5, 3.0]), "scans must be finite and at least 1"),
        (lambda: maneuvers(HMM, agility=0.5), "agility must be finite and at least 1"),
        (lambda: maneuvers(HMM, turn_rate=-1.0), "turn_rate must be finite"),
        (lambda: maneuvers(constant_acceleration(1.0, 1.0)), "model must have the state"),
        (lambda: coordinated_turn(np.nan, 1.0, 1.0), "turn_rate must be finite"),
        (lambda: SensorAdaptation(lag=0), "lag must be at least 1"),
        (lambda: SensorAdaptation(memory=0.0), "memory must be finite and > 0"),
        (lambda: SensorAdaptation(detection_limits=(0.5, 1.0)), "detection_limits must be ascending"),
        (lambda: SensorAdaptation(birth_limits=(1.0, 0.5)), "birth_limits must be ascending"),
        (lambda: RobustPMB(HMM, SITES, clutter_intensity=1e-6, volume=0.0), "volume must be finite and > 0"),
        (
            lambda: RobustPMB(HMM, SITES, clutter_intensity=1e-6, volume=1.0, clutter_density=2.0),
            "clutter_density must be a function or None, got 2.0",
        ),
        (
            lambda: RobustPMB(HMM, SITES, clutter_intensity=lambda z: z[:, 0], volume=1.0),
            "clutter_intensity must be a number",
        ),
        (
            lambda: RobustPMB(HMM, SITES, clutter_intensity=1e-6, volume=1.0, modes=maneuvers(PMM)),
            "modes must have the measurement of model",
        ),
        (lambda: RegionSurvival(HMM, 1.5, [0, 0], [1, 1]), "survival must be in"),
        (lambda: RegionSurvival(HMM, 0.9, [0, 0], [1, -1]), "low and high must have shape"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_survival_ends_at_the_edge_of_the_region():
    edge = RegionSurvival(PMM, 0.99, np.full(2, -100.0), np.full(2, 100.0))
    states = np.array([[0.0, 5.0, 0.0, 5.0], [95.0, 30.0, 0.0, 0.0], [90.0, 10.0, 0.0, 0.0], [200.0, 0.0, 0.0, 0.0]])
    found = edge(states)
    np.testing.assert_allclose(found, [0.99, 0.0, 0.495, 0.0], atol=1e-6)


# Growth


def crowd(number, scans, seed=3):
    rng = np.random.default_rng(seed)
    place = rng.uniform(-20_000.0, 20_000.0, (number, 2))
    speed = rng.normal(0.0, 8.0, (number, 2))
    for k in range(scans):
        yield place + k * speed + rng.normal(0.0, 1.5, place.shape)


@pytest.mark.parametrize("kind", [PMB, GMCBMeMBer, GMPHD, GlobalNearestNeighbor, RobustPMB])
def test_a_thousand_targets_are_tracked_with_default_arguments(kind):
    birth = MeasurementBirth(100.0, 10.0)
    options = {"clutter_intensity": 1e-9, "detection": 0.98}
    if kind is RobustPMB:
        options |= {"volume": 1.6e9, "modes": maneuvers(HMM)}
    tracker = Stateful(kind(HMM) if kind is GlobalNearestNeighbor else kind(HMM, birth, **options))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for z in crowd(1000, 18):
            estimate = tracker.step(z)
    assert len(estimate.states) >= 998


@pytest.mark.parametrize(
    "filter_",
    [
        PMB(HMM, MeasurementBirth(), clutter_intensity=1e-9, reduction=Reduction(components=5, tracks=20)),
        PMB(HMM, MeasurementBirth(), clutter_intensity=1e-9, reduction=Reduction(components=5, pool=20)),
        GMCBMeMBer(HMM, MeasurementBirth(), clutter_intensity=1e-9, reduction=Reduction(components=5, tracks=20)),
        GMPHD(HMM, MeasurementBirth(), clutter_intensity=1e-9, reduction=Reduction(components=20)),
        GlobalNearestNeighbor(HMM, capacity=20),
    ],
)
def test_a_cap_of_the_caller_warns(filter_):
    tracker = Stateful(filter_)
    with pytest.warns(UserWarning, match="the cap on .* removes .* raise it"):
        for z in crowd(60, 8):
            estimate = tracker.step(z)
    assert len(estimate.states) <= 20


def poisson_filters(**options):
    """Filters with an intensity of undetected targets that does not warn by itself."""
    yield PMB(HMM, **options)
    yield TrajectoryPMB(HMM, lag=2, **options)
    yield RobustPMB(HMM, volume=1e10, adaptation=None, **options)


def far_births(number, weight):
    """Births of targets at places, and with a speed, that are too far apart to merge, also with earlier ones."""
    places = np.zeros((number, 4))
    places[:, 0], places[:, 3] = 1000.0 * np.arange(number), 200.0
    return Birth(np.full(number, weight), places, np.diag([10.0, 1.0, 10.0, 1.0]))


def test_undetected_targets_are_never_cut_in_silence():
    options = {"birth": far_births(60, 0.01), "clutter_intensity": 1e-9, "detection": 0.1}
    for grown, given in zip(poisson_filters(**options), poisson_filters(undetected=1000, **options), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            a, b = Stateful(grown), Stateful(given)
            for _ in range(6):
                one, two = a.step(np.zeros((0, 2))), b.step(np.zeros((0, 2)))
                assert one.expected_number == pytest.approx(two.expected_number, rel=1e-12)
        assert a.state.undetected.number > 100 and a.state.undetected.weight.shape in ((200,), (400,))
    for capped in poisson_filters(undetected=50, **options):
        with pytest.warns(UserWarning, match="the cap on undetected removes components .* raise it"):
            Stateful(capped).step(np.zeros((0, 2)))
    few = {**options, "birth": far_births(60, 1e-4)}
    for capped in poisson_filters(undetected=50, **few):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            Stateful(capped).step(np.zeros((0, 2)))


def test_a_grown_intensity_of_undetected_targets_mixes_with_a_new_one():
    filter_ = PMB(HMM, far_births(60, 0.01), clutter_intensity=1e-9, detection=0.1)
    rows = np.zeros((2, 1, 3))
    state = filter_.initial(rows)
    for _ in range(4):
        state, _ = filter_.step(state, rows)
    mixed = select_rows(np.array([True, False]), filter_.initial(rows), state)
    after, _ = filter_.step(mixed, rows)
    alone, _ = filter_.step(filter_.initial(rows), rows)
    assert after.undetected.number[0] == alone.undetected.number[0] < after.undetected.number[1]


@pytest.mark.parametrize("kind", [PMB, GMCBMeMBer, GMPHD, PMBM, RobustPMB])
def test_every_unexplained_measurement_has_a_birth(kind):
    options = {"clutter_intensity": 1e-9, "detection": 0.98}
    if kind is RobustPMB:
        options |= {"volume": 1.6e9}
    first = next(crowd(250, 1))
    # A share of the expected births is left for each of them.
    born = kind(HMM, MeasurementBirth(25.0, 10.0), **options)
    state, _ = born.step(born.initial(first), first)
    assert (state.births.weight > 0.0).sum() == 250
    capped = kind(HMM, MeasurementBirth(25.0, 10.0, places=100), **options)
    with pytest.warns(UserWarning, match="the cap on places of births removes births"):
        state, _ = capped.step(capped.initial(first), first)
    assert (state.births.weight > 0.0).sum() == 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        capped.step(capped.initial(first), first[:100])


def test_growth_changes_no_result_and_grown_states_mix_with_new_ones():
    small = PMB(HMM, MeasurementBirth(50.0, 10.0), clutter_intensity=1e-9)
    large = PMB(
        HMM, MeasurementBirth(50.0, 10.0), clutter_intensity=1e-9, reduction=Reduction(components=5, tracks=800)
    )
    a, b = Stateful(small), Stateful(large)
    for z in crowd(300, 8):
        one, two = a.step(z), b.step(z)
        assert np.array_equal(one.states, two.states) and np.array_equal(one.labels, two.labels)
    assert a.state.tracks.existence.shape == (400,)
    rows = np.zeros((2, 300, 3))
    rows[0, :, 0] = 1.0
    state = small.initial(rows)
    for z in crowd(300, 8):
        rows[0, :, 1:] = z
        state, _ = small.step(state, rows)
    restarted = select_rows(np.array([False, True]), small.initial(rows), state)
    _, estimate = small.step(restarted, rows)
    assert (estimate.labels[0] > 0).sum() >= 298
    assert restarted.tracks.existence.shape == state.tracks.existence.shape


def test_another_sensor_helps_and_leaves_the_estimates_of_the_own_one_alone():
    # The own sensor finds .7, not the .95 that it is told, among 20 false measurements, not 5; a second one, known to
    # find .9 among 2, scans in between.
    other = LinearSensor(HMM.observation, 4.0 * np.eye(2), detection=0.9, clutter_intensity=2.0 / AREA)
    errors = []
    for run in range(12):
        rng = np.random.default_rng(SEED + run)
        filter = RobustPMB(
            constant_velocity(0.5, 1.5), SITES, clutter_intensity=5.0 / AREA, volume=AREA, detection=0.95
        )
        state = filter.initial(np.zeros((0, 2)))
        starts = np.array([[0.0, 3.0, 0.0, 2.0], [400.0, -2.0, 0.0, 3.0]])
        for k in range(90):
            true = starts[:, [0, 2]] + k * starts[:, [1, 3]]
            for sensor, chance, deviation, false in ((None, 0.7, 1.5, 20), (other, 0.9, 2.0, 2)):
                seen = true[rng.random(2) < chance]
                clutter = rng.uniform(-2000.0, 2000.0, (rng.poisson(false), 2))
                z = np.vstack([seen + rng.normal(0.0, deviation, seen.shape), clutter])
                # Half a period apart.
                state, estimate = filter.step(state, z, 0.5, sensor)
        errors.append([state.sensor.detection - 0.7, state.sensor.clutter_rate / 20.0 - 1.0])
        assert len(estimate.states) == 2
    mean = np.abs(np.mean(errors, axis=0))
    assert mean[0] < 0.04 and mean[1] < 0.1, mean


def test_a_scan_of_another_sensor_counts_nothing_and_forgets_nothing():
    adaptation = SensorAdaptation()
    before = adaptation.initial(1, 3, 0.9, 10.0)
    tally = Tally(np.full((1, 4), 0.7), np.full((1, 3), 0.8), np.array([[0, 1, 2]]), np.zeros((1, 4)))
    alive = np.full((1, 3), 0.95)
    counted = adaptation.step(before, alive, 0.99 * alive, alive, tally)
    held = adaptation.step(counted, alive, 0.99 * alive, alive, tally, own=False)
    for name in ("found", "missed", "false", "scans", "born", "watched", "age"):
        np.testing.assert_array_equal(getattr(held, name), getattr(counted, name))
    # The events stay in their place; only who is still alive is known better.
    np.testing.assert_allclose(held.pending.sum(axis=4), counted.pending.sum(axis=4), rtol=0.1)
    assert held.pending[0, 0, 0].sum() > 0.8


def test_another_sensor_must_say_what_cannot_be_estimated():
    filter = RobustPMB(HMM, SITES, clutter_intensity=5.0 / AREA, volume=AREA)
    silent = LinearSensor(HMM.observation, np.eye(2), detection=0.9)
    with pytest.raises(ValueError, match="sensor must state its clutter_intensity in a filter that estimates"):
        filter.step(filter.initial(np.zeros((0, 2))), np.zeros((1, 2)), sensor=silent)


@pytest.mark.parametrize(
    ("switching", "expected"),
    [
        (lasting([10.0, 5.0]), [2.0 / 3.0, 1.0 / 3.0]),
        (lasting([40.0, 10.0, 10.0, 10.0]), [4.0 / 7.0, 1.0 / 7.0, 1.0 / 7.0, 1.0 / 7.0]),
        (np.eye(3), [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0]),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), [0.5, 0.5]),
        (np.array([[1.0, 0.0], [0.5, 0.5]]), [1.0, 0.0]),
    ],
)
def test_stationary_distribution_of_modes(switching: np.ndarray, expected: list[float]) -> None:
    np.testing.assert_allclose(_stationary(switching), expected, rtol=1e-13, atol=1e-15)
