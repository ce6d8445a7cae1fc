"""The lifted Kalman filter: exact where its model is, positive definite always, and accurate in closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kinematic_world import KinematicWorld, closed_loop, ellipse_target, two_sine_target, wander, waypoint_target

from servotrack.estimators.jacobian import LiftedKalman, OneStepExact, ServoController, ServoMeasurement, TargetModel

PLAIN = LiftedKalman(
    models=(TargetModel(jerk=1e-3),), noise=(1e-3,), encoder_noise=0.0, optics_error=0.0, outlier_rate=0.0, drift=0.0
)
"""The Kalman filter of the exact linear system."""


def accelerated(time):
    return np.stack([0.55 + 0.1 * time - 0.02 * time**2, 0.55 - 0.05 * time + 0.01 * time**2], axis=-1)


def three_arms(**options) -> KinematicWorld:
    geometry = {"links": np.array([[0.5, 0.5], [0.4, 0.6], [0.6, 0.45]]), "alpha": [400.0, 300.0, 600.0]}
    return KinematicWorld(accelerated, rows=3, mounting=[0.0, 1.0, -2.5], image_size=1e6, **(geometry | options))


def servo(estimator: LiftedKalman) -> ServoController:
    return ServoController(estimator, OneStepExact(gain=0.9), supervisor=None)


def steady(world: KinematicWorld, estimator: LiftedKalman) -> np.ndarray:
    """Mean error of each row for t > 3 s, m."""
    return closed_loop(servo(estimator), world)[world.warmup + 60 :].mean(axis=0)


@pytest.mark.parametrize("goal", [None, (200.0, 260.0)])
def test_exact_data_leave_no_innovation(goal):
    world = three_arms(goal=goal)
    before = None
    for step, (_, estimate) in enumerate(wander(PLAIN, world, 80)):
        if step > 40:
            np.testing.assert_allclose(estimate.error, world.error, atol=1e-2)
            np.testing.assert_allclose(estimate.jacobian, world.jacobian, atol=0.5)
            predicted = before[1].predict_error(world.joints - before[0], world.period)
            np.testing.assert_allclose(predicted, world.error, atol=1e-2)
        before = world.joints, estimate


def test_prediction_turns_the_arm_and_does_not_follow_the_tangent():
    world = three_arms()
    for _, last in wander(PLAIN, world, 60):
        estimate = last
    motion = np.array([0.4, -0.5])
    world.joints = world.joints + motion
    world.time += 0.2
    exact = world.error
    np.testing.assert_allclose(estimate.predict_error(np.tile(motion, (3, 1)), 0.2), exact, atol=0.05)
    tangent = estimate.error + estimate.jacobian[..., :2] @ motion + 0.2 * estimate.jacobian[..., 2]
    assert np.abs(tangent - exact).max() > 10.0


@pytest.mark.parametrize("latency", [1, 2])
def test_late_stamped_frames_are_bridged_exactly(latency):
    world = three_arms(latency=latency)
    for step, (_, estimate) in enumerate(wander(PLAIN, world, 80)):
        if step > 45:
            np.testing.assert_allclose(estimate.error, world.error, atol=0.05)


def test_dropped_frames_are_predicted_through():
    world = three_arms(drop_rate=0.5, seed=3)
    for step, (_, estimate) in enumerate(wander(PLAIN, world, 120)):
        if step > 80:
            np.testing.assert_allclose(estimate.error, world.error, atol=0.05)


def test_larger_world_seen_from_farther_gives_the_same_estimates():
    scale = 3.0
    small, large = three_arms(), three_arms()
    large.links, large.alpha = scale * np.asarray(large.links), np.asarray(large.alpha) / scale
    large.target = lambda time: scale * accelerated(time)
    for (_, one), (_, other) in zip(wander(LiftedKalman(), small, 50), wander(LiftedKalman(), large, 50), strict=True):
        np.testing.assert_allclose(one.jacobian, other.jacobian, rtol=1e-6, atol=1e-6)


def test_rows_do_not_know_of_each_other():
    options = {"pixel_noise": 1.0, "outlier_rate": 0.1, "drop_rate": 0.1, "latency": 1}
    estimator = LiftedKalman()
    together = list(wander(_Recorder(estimator), three_arms(**options), 60))
    for row in range(3):
        state = estimator.initial(_row(together[0][0], row))
        for measurement, estimate in together:
            state, alone = estimator.step(state, _row(measurement, row))
            np.testing.assert_allclose(alone.jacobian, estimate.jacobian[row], rtol=1e-12, atol=1e-10)
            np.testing.assert_array_equal(alone.nis, estimate.nis[row])


class _Recorder:
    """Hands out the measurements in place of the states."""

    def __init__(self, estimator: LiftedKalman) -> None:
        self.estimator = estimator

    def initial(self, measurement):
        self._state = self.estimator.initial(measurement)

    def step(self, state, measurement):
        self._state, estimate = self.estimator.step(self._state, measurement)
        return measurement, estimate


def _row(measurement: ServoMeasurement, row: int) -> ServoMeasurement:
    return ServoMeasurement(*(values[row] for values in measurement[:6]))


def test_nis_is_one_on_average_when_the_model_holds():
    estimator = LiftedKalman(
        models=(TargetModel(jerk=0.01),), noise=(0.8,), encoder_noise=0.0, optics_error=0.0, outlier_rate=0.0, drift=0.0
    )
    world = KinematicWorld(accelerated, rows=60, pixel_noise=0.8, image_size=1e6)
    nis = [estimate.nis for _, estimate in wander(estimator, world, 160)]
    assert np.mean(nis[60:]) == pytest.approx(1.0, abs=0.05)


def test_noise_level_is_learned():
    estimator = LiftedKalman(noise=(0.3, 1.0, 3.0), optics_error=0.0, encoder_noise=0.0)
    world = KinematicWorld(accelerated, rows=90, pixel_noise=np.repeat([0.3, 1.0, 3.0], 30), image_size=1e6)
    weights = [state.noise_weight for state, _ in wander(estimator, world, 120)][-1]
    right = weights[np.arange(90), np.repeat([0, 1, 2], 30)]
    assert np.mean(right > 0.5) > 0.9


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), alpha=st.floats(100.0, 2000.0), outlier_rate=st.sampled_from([0.0, 0.1]))
def test_covariances_stay_positive_definite_over_very_many_steps(seed, alpha, outlier_rate):
    """A hundred rows for a thousand steps: 10^5 random ones."""
    world = KinematicWorld(
        two_sine_target(np.random.default_rng(seed), 100), 100, seed, alpha=alpha, pixel_noise=1.0, encoder_noise=0.001,
        outlier_rate=outlier_rate, drop_rate=0.1, image_size=1e6,
    )  # fmt: skip
    for step, (state, estimate) in enumerate(wander(LiftedKalman(), world, 1000, seed)):
        if step % 50 == 0 or step == 999:
            assert (np.linalg.eigvalsh(state.covariance) > 0.0).all()
            np.testing.assert_allclose(state.covariance, np.conj(np.swapaxes(state.covariance, -1, -2)))
            np.testing.assert_allclose(state.model_weight.sum(axis=-1), 1.0)
            assert np.isfinite(estimate.jacobian).all() and np.isfinite(estimate.log_likelihood).all()


def test_closed_loop_at_any_mounting():
    rng = np.random.default_rng(0)
    world = KinematicWorld(
        ellipse_target(rng, 60), rows=60, mounting=rng.uniform(-np.pi, np.pi, 60), pixel_noise=0.5, warmup=0
    )
    assert steady(world, LiftedKalman()).max() < 0.004


def test_outliers_cost_little():
    clean = steady(KinematicWorld(rows=30, pixel_noise=0.5), LiftedKalman())
    dirty = steady(KinematicWorld(rows=30, pixel_noise=0.5, outlier_rate=0.05), LiftedKalman())
    assert dirty.mean() < 1.5 * clean.mean()


def test_abrupt_manoeuvres_are_followed_and_not_taken_for_outliers():
    """With an outlier model but one quiet model of the target, a corner would be refused frame after frame."""

    def world() -> KinematicWorld:
        return KinematicWorld(
            waypoint_target(np.random.default_rng(2), 30), rows=30, pixel_noise=1.0, outlier_rate=0.05, image_size=1e6
        )

    agile = LiftedKalman()
    deaf = LiftedKalman(models=agile.models[:1], outlier_rate=0.05)
    assert np.median(steady(world(), agile)) < 0.6 * np.median(steady(world(), deaf))


def test_forgetting_keeps_the_mean():
    estimator = LiftedKalman()
    state = [state for state, _ in wander(estimator, three_arms(), 30)][-1]
    forgotten = estimator.forget(state)
    np.testing.assert_array_equal(forgotten.mean, state.mean)
    assert (forgotten.covariance[..., 0, 0].real > state.covariance[..., 0, 0].real).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"models": ()}, "models must"),
        ({"noise": ()}, "noise must"),
        ({"noise": (0.5, -1.0)}, "noise must"),
        ({"arm_spread": 0.0}, "arm_spread must"),
        ({"drift": -1.0}, "drift must"),
        ({"model_stay": 0.0}, "model_stay must"),
        ({"model_stay": 1.0}, "model_stay must"),
        ({"outlier_rate": 1.0}, "outlier_rate must"),
    ],
)
def test_bad_parameters_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        LiftedKalman(**options)


def test_other_arms_are_refused():
    measurement = ServoMeasurement(*(np.zeros(n) for n in (3, 2, 2)), np.bool_(True), np.float64(0.0), np.float64(0.0))
    with pytest.raises(ValueError, match="joint_angles with 3"):
        LiftedKalman().initial(measurement)
