"""Parametric filters, and the banks that find a mounting angle and a latency that nobody told."""

from __future__ import annotations

import numpy as np
import pytest
from kinematic_world import KinematicWorld, closed_loop, ellipse_target, still_target, wander

from servotrack.estimators.jacobian import (
    HypothesisBank,
    KalmanJacobian,
    Latencies,
    LiftedKalman,
    Mountings,
    OneStepExact,
    ParametricKalman,
    ServoController,
    ServoMeasurement,
)

WIDE = 1e6
"""An image so wide that nothing leaves it, px."""


def servo(estimator) -> ServoController:
    return ServoController(estimator, OneStepExact(gain=0.9), supervisor=None)


def steady(world: KinematicWorld, estimator) -> np.ndarray:
    """Mean error of each row for t > 3 s, m."""
    return closed_loop(servo(estimator), world)[world.warmup + 60 :].mean(axis=0)


@pytest.mark.parametrize("unscented", [False, True])
def test_parameters_are_found(unscented):
    links, mounting, alpha = np.array([0.5, 0.6]), 0.3, 420.0
    world = KinematicWorld(
        still_target([0.6, 0.5]), rows=1, links=links, mounting=mounting, alpha=alpha, pixel_noise=0.5, image_size=WIDE
    )
    estimator = ParametricKalman(
        unscented=unscented, pixel_noise=0.5, jerk=1e-4, drift=0.0, encoder_noise=0.0, optics_error=0.0
    )
    for state, estimate in wander(estimator, world, 300):
        last = state, estimate
    mean = last[0].mean[0]
    expected = [np.log(alpha * links[0]), mounting, links[1] / links[0], 0.6 / links[0], 0.5 / links[0]]
    np.testing.assert_allclose(mean[:5], expected, atol=0.01)
    np.testing.assert_allclose(last[1].jacobian, world.jacobian, atol=2.0)


def test_sigma_points_and_linearization_tie_in_closed_loop():
    def world() -> KinematicWorld:
        return KinematicWorld(ellipse_target(np.random.default_rng(0), 40), rows=40, pixel_noise=1.0, mounting=0.2)

    extended = steady(world(), ParametricKalman())
    unscented = steady(world(), ParametricKalman(unscented=True))
    assert extended.max() < 0.006
    np.testing.assert_allclose(unscented.mean(), extended.mean(), rtol=0.05)


def test_one_parametric_filter_needs_the_mounting_and_the_bank_does_not():
    mounting = np.linspace(-np.pi, np.pi, 40, endpoint=False)

    def world() -> KinematicWorld:
        target = ellipse_target(np.random.default_rng(0), 40)
        return KinematicWorld(target, rows=40, pixel_noise=1.0, mounting=mounting, warmup=0)

    alone = steady(world(), ParametricKalman())
    bank = steady(world(), HypothesisBank(ParametricKalman(), Mountings()))
    assert np.mean(alone < 0.01) < 0.7
    assert np.mean(bank < 0.01) >= 0.95


def test_bank_recovers_the_mounting():
    mounting = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    world = KinematicWorld(still_target([0.65, 0.55]), rows=24, pixel_noise=0.5, mounting=mounting, image_size=WIDE)
    state, _ = list(wander(HypothesisBank(ParametricKalman(), Mountings()), world, 100))[-1]
    best = state.log_weight.argmax(axis=-1)
    found = state.members.mean[np.arange(24), best, 1]
    assert np.mean(np.abs(np.angle(np.exp(1j * (found - mounting)))) < 0.05) >= 0.95


@pytest.mark.parametrize("estimator", [LiftedKalman(), KalmanJacobian()], ids=["lifted", "kf"])
def test_bank_recovers_an_unstamped_latency(estimator):
    latency = np.repeat([0, 1, 2], 20)
    target = ellipse_target(np.random.default_rng(1), 60)
    world = KinematicWorld(target, rows=60, pixel_noise=0.5, latency=latency, stamped=False, warmup=0, image_size=WIDE)
    state, _ = list(wander(HypothesisBank(estimator, Latencies((0.0, 0.05, 0.1))), world, 100))[-1]
    assert np.mean(state.log_weight.argmax(axis=-1) == latency) >= 0.95


def test_bank_serves_what_an_unaligned_filter_loses():
    def world() -> KinematicWorld:
        target = ellipse_target(np.random.default_rng(1), 60)
        return KinematicWorld(
            target, rows=60, pixel_noise=0.5, latency=np.repeat([0, 1, 2], 20), stamped=False, warmup=0
        )

    assert np.mean(steady(world(), LiftedKalman()) < 0.01) < 0.7
    assert np.mean(steady(world(), HypothesisBank(LiftedKalman(), Latencies())) < 0.01) >= 0.95


def test_bank_answers_as_its_best_member_would_alone():
    world = KinematicWorld(ellipse_target(np.random.default_rng(0), 4), rows=4, latency=1, stamped=False)
    bank, member = HypothesisBank(LiftedKalman(), Latencies((0.05,))), LiftedKalman()
    stamped = KinematicWorld(ellipse_target(np.random.default_rng(0), 4), rows=4, latency=1)
    for (_, one), (_, other) in zip(wander(bank, world, 40), wander(member, stamped, 40), strict=True):
        np.testing.assert_allclose(one.jacobian, other.jacobian, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            one.predict_error(np.full((4, 2), 0.1), 0.05), other.predict_error(np.full((4, 2), 0.1), 0.05)
        )


@pytest.mark.parametrize("unscented", [False, True])
def test_covariances_stay_positive_definite(unscented):
    """A hundred rows for a thousand steps: 10^5 random ones."""
    world = KinematicWorld(
        ellipse_target(np.random.default_rng(3), 100),
        100,
        3,
        mounting=0.2,
        pixel_noise=1.0,
        drop_rate=0.1,
        image_size=WIDE,
    )
    for step, (state, estimate) in enumerate(wander(ParametricKalman(unscented=unscented), world, 1000)):
        if step % 50 == 0:
            assert (np.linalg.eigvalsh(state.covariance) > 0.0).all()
            assert np.isfinite(estimate.jacobian).all()


def test_forgetting_makes_all_hypotheses_equal_again():
    world = KinematicWorld(rows=3, latency=1, stamped=False)
    bank = HypothesisBank(LiftedKalman(), Latencies())
    state, _ = list(wander(bank, world, 30))[-1]
    assert (state.log_weight.min(axis=-1) < -1.0).any()
    assert (bank.forget(state).log_weight == 0.0).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Latencies(()), "ages must"),
        (lambda: Latencies((-0.05,)), "ages must"),
        (lambda: Mountings(0), "count must"),
        (lambda: HypothesisBank(LiftedKalman(), Latencies(), forgetting=0.0), "forgetting must"),
        (lambda: HypothesisBank(LiftedKalman(), Latencies(), floor=0.0), "floor must"),
        (lambda: ParametricKalman(scale=-1.0), "scale must"),
        (lambda: ParametricKalman(kappa=-9.0), "kappa must"),
        (lambda: ParametricKalman(mounting=np.nan), "mounting must"),
    ],
)
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_other_arms_are_refused():
    measurement = ServoMeasurement(*(np.zeros(n) for n in (3, 2, 2)), np.bool_(True), np.float64(0.0), np.float64(0.0))
    with pytest.raises(ValueError, match="3 and features with 2"):
        ParametricKalman().initial(measurement)
