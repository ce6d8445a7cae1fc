"""Smoothed trajectories with the sensor that an adaptive filter estimates beside them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from servotrack.estimators.rfs import (
    PMB,
    Births,
    LinearSensor,
    MeasurementBirth,
    RobustPMB,
    RobustTrajectoryPMB,
    TrajectoryPMB,
    constant_velocity,
    maneuvers,
    pairwise_structure,
    track_scans,
)
from servotrack.estimators.rfs.birth import Birth

HMM = constant_velocity(1.0, 2.0)
SITES = Birth([0.02], [[0.0, 0.0, 0.0, 0.0]], np.diag([100.0, 25.0] * 2))
VOLUME = 400.0**2


def scans(seed: int, number: int = 30, detection: float = 0.6) -> list[np.ndarray]:
    """Two targets that are detected less often than stated, and clutter."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(number):
        places = np.array([[3.0 * k, 0.0], [0.0, 50.0 - 4.0 * k]]) + rng.normal(0.0, 2.0, (2, 2))
        found.append(np.concatenate([places[rng.random(2) < detection], rng.uniform(-200.0, 200.0, (5, 2))]))
    return found


def guide(model: Any = HMM, **changes: Any) -> RobustPMB:
    settings = {"clutter_intensity": 5.0 / VOLUME, "detection": 0.9, "volume": VOLUME, **changes}
    return RobustPMB(model, Births(SITES, MeasurementBirth(0.02, 5.0, largest=0.02)), **settings)


def assert_equal(one: Any, two: Any) -> None:
    for a, b in zip(vars(one).values(), vars(two).values(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_without_adaptation_it_is_the_trajectory_filter() -> None:
    fixed = guide(adaptation=None)
    smoother = RobustTrajectoryPMB(fixed, lag=4)
    plain = TrajectoryPMB(HMM, fixed.birth, clutter_intensity=5.0 / VOLUME, detection=0.9, lag=4)
    data = scans(0)
    one, two = smoother.initial(data[0]), plain.initial(data[0])
    for z in data:
        one, first = smoother.step(one, z)
        two, second = plain.step(two, z)
        assert_equal(first, second)
    for first, second in zip(smoother.flush(one), plain.flush(two), strict=True):
        assert_equal(first, second)


def denser_left(z: np.ndarray) -> np.ndarray:
    return np.where(z[:, 0] < 0.0, 1.5, 0.5)


def test_maneuvers_and_the_shape_of_clutter_are_those_of_the_trajectory_filter() -> None:
    fixed = guide(adaptation=None, clutter_density=denser_left)

    def clutter(z: np.ndarray) -> np.ndarray:
        return 5.0 / VOLUME * denser_left(z)

    more = {"maneuver": 0.1, "agility": 4.0, "lag": 4}
    smoother = RobustTrajectoryPMB(fixed, **more)
    plain = TrajectoryPMB(HMM, fixed.birth, clutter_intensity=clutter, detection=0.9, **more)
    data = scans(0)
    one, two = smoother.initial(data[0]), plain.initial(data[0])
    for z in data:
        (one, first), (two, second) = smoother.step(one, z), plain.step(two, z)
        assert_equal(first, second)
    pickle.loads(pickle.dumps(smoother))


@pytest.mark.parametrize("density", [None, denser_left])
@pytest.mark.parametrize("model", [HMM, pairwise_structure(constant_velocity(5.0, 1.5))])
def test_runs_of_a_batch_are_those_of_single_ones(model: Any, density: Any) -> None:
    own = guide(model, modes=maneuvers(model), clutter_density=density)
    smoother = RobustTrajectoryPMB(own, maneuvers(model, agility=1.5).models[1], lag=3)
    runs = [scans(1, 20), scans(2, 20, detection=0.95)]
    rows = max(len(z) for run in runs for z in run)
    batch = np.zeros((20, 2, rows, 3))
    for b, run in enumerate(runs):
        for k, z in enumerate(run):
            batch[k, b, : len(z), 0], batch[k, b, : len(z), 1:] = 1.0, z
    singles, state = [smoother.initial(run[0]) for run in runs], smoother.initial(batch[0])
    for k in range(20):
        state, together = smoother.step(state, batch[k])
        for b, run in enumerate(runs):
            singles[b], alone = smoother.step(singles[b], run[k])
            size = len(alone.labels)
            np.testing.assert_array_equal(together.labels[b, :size], alone.labels)
            np.testing.assert_array_equal(together.states[b, :size], alone.states)
    # The two runs have sensors of their own.
    detection = state.guide.sensor.detection
    assert detection[0] < detection[1]


def test_stated_probabilities_are_those_of_a_filter_that_has_them() -> None:
    options = {"birth": MeasurementBirth(0.1, 5.0), "gate_probability": 1.0}
    one = PMB(HMM, clutter_intensity=1e-9, detection=0.3, **options)
    two = PMB(HMM, clutter_intensity=5.0 / VOLUME, detection=0.7, **options)
    now = one.stating(np.array([0.7]), np.array([5.0 / VOLUME]))
    a = b = one.initial(np.zeros((0, 2)))
    for z in scans(3, 15):
        (a, first), (b, second) = one.step_as(now, a, z), two.step(b, z)
        assert_equal(first, second)
    assert one.detection == 0.3


def test_a_wrong_sensor_is_learned_and_other_sensors_state_theirs() -> None:
    smoother = RobustTrajectoryPMB(guide(detection=0.95, clutter_intensity=50.0 / VOLUME), lag=5)
    data = scans(4, 60)
    state = smoother.initial(data[0])
    for k, z in enumerate(data):
        state, estimate = smoother.step(state, z, 1.0 if k else None)
    assert state.guide.sensor.detection < 0.8 and state.guide.sensor.clutter_rate < 12.0
    assert len(estimate.labels) == 2
    other = LinearSensor(HMM.observation, 4.0 * np.eye(2), detection=0.9, clutter_intensity=1e-6)
    held = state.guide.sensor.detection
    state, _ = smoother.step(state, np.array([[177.0, 0.0]]), 0.0, other, np.array([np.eye(2)]))
    assert state.guide.sensor.detection == pytest.approx(held, abs=0.02)


def test_trajectories_are_collected() -> None:
    found = track_scans(RobustTrajectoryPMB(guide(), lag=5), scans(5, 40, detection=0.8), np.arange(40.0))
    assert sorted(len(one) for one in found)[-2] >= 30


def test_bad_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="guide must be a RobustPMB, got PMB"):
        RobustTrajectoryPMB(PMB(HMM, SITES, clutter_intensity=1e-6))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="lag must be"):
        RobustTrajectoryPMB(guide(), lag=-1)
    smoother = RobustTrajectoryPMB(guide())
    with pytest.raises(ValueError, match="sensor must state its detection"):
        smoother.step(
            smoother.initial(np.zeros((0, 2))), np.zeros((0, 2)), 1.0, LinearSensor(HMM.observation, np.eye(2))
        )
