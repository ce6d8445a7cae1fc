"""The cardinalized PHD filter: equal to the enumeration of all associations, and counts better than the PHD filter."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
from scipy import stats

from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.rfs import (
    GMCPHD,
    GMPHD,
    Birth,
    MeasurementBirth,
    Reduction,
    Spawn,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.rfs.cphd import CPHDState, elementary_symmetric
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.stateful import Stateful, select_rows

HMM = constant_velocity(1.0, 1.5)
NOTHING = Reduction(prune=0.0, merge=0.0, components=200)


def known_state(filter_: GMCPHD, cardinality: np.ndarray, weight: np.ndarray, mean: np.ndarray) -> CPHDState:
    """A state with this distribution of the number of targets and these components of width 2."""
    empty = filter_.initial(np.zeros((0, 2)))
    room = empty.intensity.weight.shape[0]
    weights, means, covariances = np.zeros(room), np.zeros((room, 6)), np.zeros((room, 6, 6))
    count = len(weight)
    weights[:count], means[:count, :4] = weight, mean
    covariances[:count, :4, :4] = np.diag([4.0, 1.0, 4.0, 1.0])
    labels = np.zeros(room, np.int64)
    labels[:count] = np.arange(1, count + 1)
    numbers = np.zeros(len(empty.cardinality))
    numbers[: len(cardinality)] = cardinality
    intensity = Mixture(np.array(count), weights, means, covariances, np.ones(room, np.bool_), labels)
    return empty._replace(intensity=intensity, cardinality=numbers, next_label=np.array(count + 1))


def enumerated(
    filter_: GMCPHD, cardinality: np.ndarray, weight: np.ndarray, mean: np.ndarray, z: np.ndarray, births: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Posterior number, expected number of missed targets and of targets of each measurement, by enumeration.

    Targets are independent and identically distributed given their number. Every subset of the measurements may be that
    of targets, which are any of them in any order.
    """
    p_s, p_d, kappa = filter_.survival, filter_.detection, filter_.clutter_intensity
    most = len(cardinality) + 60
    survived = np.zeros(most)
    for number, chance in enumerate(cardinality):
        survived[: number + 1] += chance * stats.binom.pmf(np.arange(number + 1), number, p_s)
    born = stats.poisson.pmf(np.arange(most), births)
    prior = np.convolve(survived, born)[:most]
    F, Q = HMM.transition, HMM.process_noise
    P = F @ np.diag([4.0, 1.0, 4.0, 1.0]) @ F.T + Q
    S = HMM.observation @ P @ HMM.observation.T + HMM.measurement_noise
    density = np.zeros((len(weight) + 1, len(z)))
    for i, x in enumerate(mean):
        density[i] = stats.multivariate_normal(HMM.observation @ F @ x, S).pdf(z)
    B = HMM.observation @ filter_.birth.covariances[0] @ HMM.observation.T + HMM.measurement_noise
    density[-1] = stats.multivariate_normal(np.zeros(2), B).pdf(z)
    v = np.append(p_s * weight, births)
    s = v / v.sum()
    one = p_d * (s @ density)
    posterior, missed, owned = np.zeros(most), 0.0, np.zeros(len(z))
    for number in range(most):
        for found in range(min(number, len(z)) + 1):
            orders = math.perm(number, found)
            for subset in itertools.combinations(range(len(z)), found):
                value = prior[number] * orders * (1.0 - p_d) ** (number - found) * kappa ** (len(z) - found)
                value *= np.prod(one[list(subset)])
                posterior[number] += value
                missed += value * (number - found)
                owned[list(subset)] += value
    total = posterior.sum()
    return posterior / total, missed / total, owned / total


@pytest.mark.parametrize("detection", [0.6, 0.95, 1.0])
@pytest.mark.parametrize("measured", [0, 1, 4])
@pytest.mark.parametrize("seed", range(4))
def test_the_update_is_that_of_all_associations(seed: int, measured: int, detection: float) -> None:
    rng = np.random.default_rng([seed, measured])
    births = 0.3
    filter_ = GMCPHD(
        HMM,
        Birth(np.array([births]), np.zeros((1, 4)), np.diag([400.0, 4.0, 400.0, 4.0])),
        clutter_intensity=2e-3,
        survival=0.9,
        detection=detection,
        reduction=NOTHING,
        gate_loss=0.0,
    )
    cardinality = rng.dirichlet(np.ones(5))
    mean = np.zeros((3, 4))
    mean[:, [0, 2]] = rng.uniform(-15.0, 15.0, (3, 2))
    weight = rng.dirichlet(np.ones(3)) * (cardinality @ np.arange(5.0))
    z = np.concatenate([mean[:2, [0, 2]] + rng.normal(0.0, 2.0, (2, 2)), rng.uniform(-20.0, 20.0, (2, 2))])[:measured]
    state, estimate = filter_.step(known_state(filter_, cardinality, weight, mean), z)
    posterior, missed, owned = enumerated(filter_, cardinality, weight, mean, z, births)
    length = min(len(posterior), len(state.cardinality))
    np.testing.assert_allclose(state.cardinality[:length], posterior[:length], atol=1e-11)
    weights = state.intensity.weight[: int(state.intensity.number)]
    assert weights.sum() == pytest.approx(missed + owned.sum(), rel=1e-9)
    assert float(estimate.expected_number) == pytest.approx(posterior @ np.arange(len(posterior)), rel=1e-9)
    assert float(estimate.expected_number) == pytest.approx(weights.sum(), rel=1e-9)
    assert len(estimate.labels) == posterior.argmax()


def test_the_parts_of_the_intensity_are_those_of_the_measurements() -> None:
    births = MeasurementBirth(0.2, 5.0)
    filter_ = GMCPHD(HMM, births, clutter_intensity=1e-3, survival=1.0, detection=0.8, reduction=NOTHING, gate_loss=0.0)
    cardinality, weight = np.array([0.1, 0.2, 0.7]), np.array([0.9, 0.7])
    mean = np.zeros((2, 4))
    mean[1, 0] = 30.0
    z = np.array([[1.0, 0.0], [31.0, 1.0], [90.0, 90.0]])
    state, _ = filter_.step(known_state(filter_, cardinality, weight, mean), z)
    # Nothing explains the third, and births at it take its part.
    chance = state.births.weight / state.births.weight.sum()
    assert chance.max() == pytest.approx(chance[0]) and state.births.mean[0, 0] == 90.0


def test_poisson_numbers_make_it_the_phd_filter() -> None:
    """Where the number of targets is Poisson before the update, intensity and mean are those of the PHD filter."""
    rng = np.random.default_rng(4)
    options = {"clutter_intensity": 1e-3, "survival": 1.0, "detection": 0.7, "reduction": NOTHING, "gate_loss": 0.0}
    birth = Birth(np.array([0.4]), np.zeros((1, 4)), np.diag([100.0, 4.0, 100.0, 4.0]))
    cphd, phd = GMCPHD(HMM, birth, **options), GMPHD(HMM, birth, **options)
    weight, mean = np.array([0.8, 1.3]), np.zeros((2, 4))
    mean[1, 0] = 25.0
    z = rng.uniform(-10.0, 30.0, (3, 2))
    start = known_state(cphd, stats.poisson.pmf(np.arange(51), weight.sum()), weight, mean)
    ours, _ = cphd.step(start, z)
    empty = phd.initial(z)
    theirs, _ = phd.step(empty._replace(intensity=start.intensity, next_label=start.next_label), z)
    count = int(theirs.intensity.number)
    np.testing.assert_allclose(ours.intensity.weight[:count], theirs.intensity.weight[:count], rtol=1e-9)
    np.testing.assert_allclose(ours.intensity.mean[:count], theirs.intensity.mean[:count], rtol=1e-9)


def test_elementary_symmetric_functions() -> None:
    values, out = np.array([2.0, 3.0, 5.0, 7.0]), np.empty(5)
    elementary_symmetric(values, -1, out)
    expected = [sum(math.prod(c) for c in itertools.combinations(values, k)) for k in range(5)]
    np.testing.assert_allclose(out, expected)
    elementary_symmetric(values, 1, out)
    rest = [2.0, 5.0, 7.0]
    np.testing.assert_allclose(
        out, [*(sum(math.prod(c) for c in itertools.combinations(rest, k)) for k in range(4)), 0.0]
    )


@pytest.mark.parametrize("structure", ["HMM", "S1"])
def test_it_counts_better_than_the_phd_filter(structure: str) -> None:
    config = clutter_config(0, structure=structure, detection_probability=0.9)
    scene = scene_model_of(config)
    birth = Birth(scene.birth_weights, scene.birth_means, scene.birth_covariance)
    options = {"clutter_intensity": scene.clutter_intensity, "survival": 0.99, "detection": 0.9}
    wrong = {}
    for kind in (GMPHD, GMCPHD):
        errors = []
        for seed in range(4):
            episode, tracker = draw_episode(config, seed), Stateful(kind(scene.model, birth, **options))
            for k in range(60):
                z = episode.measurements[k][episode.measurements[k][:, 0] > 0.5, 1:]
                estimate = tracker.step(z)
                errors.append(abs(len(estimate.labels) - episode.exists[k].sum()))
        wrong[kind] = np.mean(errors)
    assert wrong[GMCPHD] < 0.8 * wrong[GMPHD]


def test_the_distribution_of_the_number_grows_with_the_number() -> None:
    wide = Birth(np.ones(1), np.zeros((1, 4)), np.diag([3000.0, 10.0, 3000.0, 10.0]) ** 2)
    filter_ = GMCPHD(HMM, wide, clutter_intensity=1e-9, detection=0.999)
    rng = np.random.default_rng(0)
    places = rng.uniform(-5000.0, 5000.0, (80, 2))
    tracker = Stateful(filter_)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(12):
            estimate = tracker.step(places + rng.normal(0.0, 1.5, places.shape))
    assert len(estimate.labels) == 80 and tracker.state.cardinality.shape[0] > 81
    assert tracker.state.cardinality.sum() == pytest.approx(1.0, abs=1e-12)
    for _ in range(60):
        estimate = tracker.step([])
    # One birth per scan, of which a share of 1 - p_D is missed and most of it detected in the next scan.
    assert len(estimate.labels) == 0 and float(estimate.expected_number) == pytest.approx(1e-3, rel=2e-3)
    capped = Stateful(GMCPHD(HMM, wide, clutter_intensity=1e-9, detection=0.999, targets=20))
    with pytest.warns(UserWarning, match="the cap on targets removes the probability of targets"):
        for _ in range(5):
            capped.step(places)


def test_two_thousand_births_at_once() -> None:
    many = Birth(np.ones(2000), np.zeros((2000, 4)), np.diag([100.0, 1.0, 100.0, 1.0]))
    filter_ = GMCPHD(HMM, many, clutter_intensity=1e-9, detection=0.5)
    state, estimate = filter_.step(filter_.initial(np.zeros((0, 2))), np.zeros((0, 2)))
    # Poisson, thinned by the misses.
    assert float(estimate.expected_number) == pytest.approx(1000.0, rel=1e-6)
    numbers = np.arange(len(state.cardinality))
    np.testing.assert_allclose(state.cardinality, stats.poisson.pmf(numbers, 1000.0), atol=1e-9)


def test_runs_of_a_batch_do_not_depend_on_each_other() -> None:
    filter_ = GMCPHD(HMM, MeasurementBirth(20.0, 10.0), clutter_intensity=1e-6, detection=0.9)
    rng = np.random.default_rng(1)
    rows = np.zeros((2, 70, 3))
    rows[0, :, 0], rows[1, :3, 0] = 1.0, 1.0
    rows[:, :, 1:] = rng.uniform(-3000.0, 3000.0, (2, 70, 2))
    state, alone = filter_.initial(rows), filter_.initial(rows[1, :3, 1:])
    for _ in range(6):
        state, both = filter_.step(state, rows)
        alone, one = filter_.step(alone, rows[1, :3, 1:])
    assert float(both.expected_number[1]) == pytest.approx(float(one.expected_number), rel=1e-9)
    fresh = select_rows(np.array([True, False]), filter_.initial(rows), state)
    _, after = filter_.step(fresh, rows)
    assert after.expected_number[0] < both.expected_number[0]


@pytest.mark.parametrize("model", [HMM, pairwise_structure(constant_velocity(5.0, 1.5), "S1")])
def test_intervals_survival_of_states_and_clutter_of_measurements(model: object) -> None:
    filter_ = GMCPHD(
        model,
        Birth(np.array([0.1]), np.zeros((1, 4)), np.diag([100.0, 4.0, 100.0, 4.0])),
        clutter_intensity=lambda z: np.full(len(z), 1e-4),
        survival=lambda x: np.full(len(x), 0.95),
        detection=lambda x: np.where(x[:, 0] > 0.0, 0.9, 0.5),
    )
    state = filter_.initial(np.zeros((0, 2)))
    for k in range(8):
        state, estimate = filter_.step(state, [[0.5 * k, 1.0]], 1.0 if k == 0 else 0.5)
    assert len(estimate.labels) == 1 and state.cardinality.argmax() == 1


def test_bad_arguments_are_refused_by_name() -> None:
    options = {"clutter_intensity": 1e-3}
    with pytest.raises(ValueError, match="spawn must be empty, got 1 terms"):
        GMCPHD(HMM, MeasurementBirth(), spawn=(Spawn(0.05, np.eye(4)),), **options)
    with pytest.raises(ValueError, match="targets must be at least 1 or None, got 0"):
        GMCPHD(HMM, MeasurementBirth(), targets=0, **options)
    with pytest.raises(ValueError, match=r"tail must be in \(0, 1\), got 0.0"):
        GMCPHD(HMM, MeasurementBirth(), tail=0.0, **options)
