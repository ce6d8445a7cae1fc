"""What every increment-based estimator promises."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_world import PERIOD, linear_world, run

from servotrack.estimators.jacobian import (
    Alignment,
    BroydenJacobian,
    CorrentropyNoise,
    FullKalmanJacobian,
    JacobianPrior,
    KalmanJacobian,
    LevelKalmanJacobian,
    ParticleJacobian,
    RandomWalk,
    RecursiveLeastSquares,
    ServoMeasurement,
    StudentTNoise,
    UnscentedJacobian,
)
from servotrack.estimators.jacobian.shared_covariance import shared_update

ESTIMATORS = {
    "kf": KalmanJacobian(),
    "full-kf": FullKalmanJacobian(),
    "ukf": UnscentedJacobian(),
    "pf": ParticleJacobian(particles=100),
    "student-t-pf": ParticleJacobian(particles=100, degrees_of_freedom=4.0),
    "plain-pf": ParticleJacobian(particles=100, kernel=0.0),
    "rls": RecursiveLeastSquares(),
    "broyden": BroydenJacobian(),
    "level-kf": LevelKalmanJacobian(),
    "student-t-kf": KalmanJacobian(outliers=StudentTNoise()),
    "correntropy-kf": KalmanJacobian(outliers=CorrentropyNoise()),
    "student-t-level-kf": LevelKalmanJacobian(outliers=StudentTNoise()),
}
every_estimator = pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)


def leaves(state):
    return [leaf for part in state for leaf in (leaves(part) if isinstance(part, tuple) else [part])]


@every_estimator
def test_learns_a_constant_jacobian(estimator):
    measurements, jacobian = linear_world(np.random.default_rng(1), 200, batch=(8,), noise=0.1)
    _, estimates = run(estimator, measurements)
    assert np.sqrt(np.mean((estimates[0].jacobian - jacobian) ** 2)) > 150
    assert np.sqrt(np.mean((estimates[-1].jacobian[..., :-1] - jacobian[..., :-1]) ** 2)) < 30


@every_estimator
@pytest.mark.parametrize(("n", "m"), [(3, 4), (1, 2), (4, 2)])
def test_serves_any_number_of_joints_and_features(estimator, n, m):
    measurements, jacobian = linear_world(np.random.default_rng(2), 300, batch=(3,), n=n, m=m, noise=0.1)
    _, estimates = run(estimator, measurements)
    assert estimates[-1].jacobian.shape == (3, m, n + 1)
    assert estimates[-1].error.shape == (3, m)
    assert np.sqrt(np.mean((estimates[-1].jacobian[..., :-1] - jacobian[..., :-1]) ** 2)) < 50


@every_estimator
def test_a_row_of_a_batch_is_what_it_is_alone(estimator):
    measurements, _ = linear_world(np.random.default_rng(3), 40, batch=(3, 2), noise=0.5, dropped=0.2)
    state, estimates = run(estimator, measurements)
    for row in np.ndindex(3, 2):
        alone, single = run(estimator, [ServoMeasurement(*(part[row] for part in each[:6])) for each in measurements])
        for whole, part in zip(leaves(state), leaves(alone), strict=True):
            np.testing.assert_allclose(whole[row], part, rtol=1e-11, atol=1e-11)
        for field in ("error", "jacobian", "log_likelihood", "nis"):
            whole, part = getattr(estimates[-1], field)[row], getattr(single[-1], field)
            np.testing.assert_allclose(whole, part, rtol=1e-11, atol=1e-11)


@every_estimator
def test_step_leaves_the_old_state_alone(estimator):
    measurements, _ = linear_world(np.random.default_rng(4), 12, batch=(2,), noise=0.5)
    state, _ = run(estimator, measurements[:-1])
    before = [leaf.copy() for leaf in leaves(state)]
    estimator.step(state, measurements[-1])
    for leaf, copy in zip(leaves(state), before, strict=True):
        np.testing.assert_array_equal(leaf, copy)


@every_estimator
def test_a_step_without_a_new_frame_says_and_learns_nothing(estimator):
    measurements, _ = linear_world(np.random.default_rng(5), 20, noise=0.5)
    state, estimates = run(estimator, measurements[:-1])
    last = measurements[-2]
    moved = np.array([0.02, -0.01])
    repeated = last._replace(joint_angles=last.joint_angles + moved, time=last.time + PERIOD, visible=np.asarray(False))
    _, estimate = estimator.step(state, repeated)
    assert estimate.log_likelihood == 0.0
    assert estimate.nis == 0.0
    if not isinstance(estimator, ParticleJacobian):  # Its estimate is made before it resamples, its state after.
        np.testing.assert_allclose(estimate.jacobian, estimates[-1].jacobian, rtol=1e-12)
    expected = estimates[-1].error + estimate.jacobian @ np.append(moved, PERIOD)
    np.testing.assert_allclose(estimate.error, expected, atol=1e-9)


@every_estimator
def test_nis_is_about_one_on_its_own_model(estimator):
    if isinstance(estimator, RecursiveLeastSquares):
        pytest.skip("forgetting is no model that data could be drawn from")
    if isinstance(estimator, ParticleJacobian):  # Consistent only with enough particles for its walk.
        estimator = dataclasses.replace(estimator, particles=1000)
    steps, rows, rng = 150, 12, np.random.default_rng(6)
    walk = getattr(estimator, "walk", RandomWalk())
    measurements, jacobian = linear_world(rng, steps, batch=(rows,))
    level, of_level = measurements[0].features, isinstance(estimator, LevelKalmanJacobian)
    noisy = [measurements[0]]
    for before, now in pairwise(measurements):
        jacobian = jacobian + rng.normal(0, 1, jacobian.shape) * np.sqrt(walk.variances(2))
        ds = np.concatenate([now.joint_angles - before.joint_angles, np.full((rows, 1), PERIOD)], axis=-1)
        level = level + np.einsum("rij,rj->ri", jacobian, ds)
        if of_level:
            level = level + rng.normal(0, estimator.curvature_noise, level.shape)
            noisy.append(now._replace(features=level + rng.normal(0, estimator.pixel_noise, level.shape)))
        else:
            level = level + rng.normal(0, 3.0, level.shape)
            noisy.append(now._replace(features=level))
    _, estimates = run(estimator, noisy)
    assert 0.7 < np.mean([estimate.nis for estimate in estimates[50:]]) < 1.5


@every_estimator
def test_forgetting_keeps_the_mean_and_learns_anew(estimator):
    if not hasattr(estimator, "forget"):
        pytest.skip("has no covariance to forget")
    first, _ = linear_world(np.random.default_rng(7), 60, batch=(4,), noise=0.1)
    second, jacobian = linear_world(np.random.default_rng(8), 40, batch=(4,), noise=0.1)
    state, estimates = run(estimator, first)
    # Level features of the second world begin where the first left off: only increments matter.
    shift = first[-1].features - second[0].features
    turn = first[-1].joint_angles - second[0].joint_angles
    later = [
        each._replace(
            features=each.features + shift,
            joint_angles=each.joint_angles + turn,
            time=each.time + first[-1].time,
            frame_time=each.frame_time + first[-1].time,
        )
        for each in second[1:]
    ]
    errors = []
    for begin in (state, estimator.forget(state)):
        reached = begin
        for each in later[:10]:
            reached, estimate = estimator.step(reached, each)
        errors.append(np.sqrt(np.mean((estimate.jacobian[..., :-1] - jacobian[..., :-1]) ** 2)))
    assert errors[1] < 0.8 * errors[0]
    _, kept = estimator.step(estimator.forget(state), first[-1])
    np.testing.assert_allclose(kept.jacobian, estimates[-1].jacobian, atol=30.0)


@every_estimator
@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    motion=st.sampled_from([0.0, 1e-9, 0.02, 3.0]),
    noise=st.sampled_from([0.0, 0.5, 1e4]),
)
def test_finite_input_gives_finite_output(estimator, seed, motion, noise):
    measurements, _ = linear_world(np.random.default_rng(seed), 60, batch=(2,), noise=noise, motion=motion, dropped=0.3)
    state, estimates = run(estimator, measurements)
    for estimate in estimates:
        for field in ("error", "jacobian", "log_likelihood", "nis"):
            assert np.isfinite(getattr(estimate, field)).all()
    for leaf in leaves(state[1:]):
        assert np.isfinite(leaf).all()


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    motion=st.sampled_from([1e-9, 0.02, 1.0]),
    walk=st.sampled_from([RandomWalk(1e-3, 1e-3), RandomWalk(), RandomWalk(500.0, 2000.0)]),
    measurement_noise=st.sampled_from([1e-3, 3.0, 300.0]),
)
@pytest.mark.parametrize("make", [KalmanJacobian, LevelKalmanJacobian, RecursiveLeastSquares])
def test_covariances_stay_symmetric_positive_definite(make, seed, motion, walk, measurement_noise):
    """10^5 random steps: 100 arms for 1000 steps."""
    if make is RecursiveLeastSquares:
        estimator = make(measurement_noise=measurement_noise)
    elif make is LevelKalmanJacobian:
        estimator = make(walk=walk, pixel_noise=measurement_noise)
    else:
        estimator = make(walk=walk, measurement_noise=measurement_noise)
    measurements, _ = linear_world(
        np.random.default_rng(seed), 1000, batch=(100,), noise=1.0, motion=motion, dropped=0.1
    )
    state = estimator.initial(measurements[0])
    for step, measurement in enumerate(measurements):
        state, _ = estimator.step(state, measurement)
        np.testing.assert_array_equal(state.covariance, np.swapaxes(state.covariance, -1, -2))
        if step % 20 == 19:
            scale = np.sqrt(np.einsum("bii->bi", state.covariance))
            correlation = state.covariance / (scale[:, :, None] * scale[:, None, :])
            assert np.linalg.eigvalsh(correlation).min() > 0.0


def test_one_covariance_survives_a_very_long_run():
    rng, walk = np.random.default_rng(24), RandomWalk()
    mean, covariance = np.zeros((2, 3)), np.diag([9e4, 9e4, 4e4])
    directions = np.column_stack([rng.normal(0, 0.02, (100_000, 2)), np.full(100_000, PERIOD)])
    measured, variance = rng.normal(0, 5, (100_000, 2)), 10.0 ** rng.uniform(-4, 4, 100_000)
    always, duration = np.asarray(True), np.asarray(PERIOD)
    for k in range(100_000):
        predicted = walk.widened(covariance, duration)
        mean, covariance, *_ = shared_update(mean, predicted, directions[k], measured[k], float(variance[k]), always)
        if k % 100 == 0:
            np.testing.assert_array_equal(covariance, covariance.T)
            np.linalg.cholesky(covariance)
    assert np.isfinite(mean).all()


@every_estimator
def test_a_bad_measurement_stops_every_estimator(estimator):
    measurements, _ = linear_world(np.random.default_rng(20), 5)
    state, _ = run(estimator, measurements[:-1])
    bad = measurements[-1]._replace(features=np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="features must be finite"):
        estimator.step(state, bad)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: KalmanJacobian(measurement_noise=0.0), "measurement_noise"),
        (lambda: RandomWalk(joint_noise=-1.0), "joint_noise"),
        (lambda: RandomWalk(period=0.0), "period"),
        (lambda: JacobianPrior(joint_spread=0.0), "joint_spread"),
        (lambda: JacobianPrior(mean=((np.nan, 0.0, 0.0),)), "mean"),
        (lambda: FullKalmanJacobian(measurement_covariance=((1.0, 2.0), (2.0, 1.0))), "positive definite"),
        (lambda: FullKalmanJacobian(measurement_covariance=((1.0, 0.5), (0.0, 1.0))), "symmetric"),
        (lambda: FullKalmanJacobian(measurement_covariance=-1.0), "positive definite"),
        (lambda: RecursiveLeastSquares(forgetting=1.5), "forgetting"),
        (lambda: BroydenJacobian(rate=0.0), "rate"),
        (lambda: ParticleJacobian(particles=1), "particles"),
        (lambda: ParticleJacobian(degrees_of_freedom=-1.0), "degrees_of_freedom"),
        (lambda: LevelKalmanJacobian(pixel_noise=-1.0), "pixel_noise"),
        (lambda: StudentTNoise(degrees_of_freedom=0.0), "degrees_of_freedom"),
        (lambda: CorrentropyNoise(bandwidth=0.0), "bandwidth"),
    ],
)
def test_impossible_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_parameters_that_do_not_fit_the_robot_are_refused():
    measurements, _ = linear_world(np.random.default_rng(21), 2)
    with pytest.raises(ValueError, match=r"mean must have shape \(m, n \+ 1\) = \(2, 3\)"):
        KalmanJacobian(prior=JacobianPrior(mean=((1.0, 2.0),))).initial(measurements[0])
    with pytest.raises(ValueError, match=r"measurement_covariance must have shape \(m, m\)"):
        FullKalmanJacobian(measurement_covariance=((1.0,),)).initial(measurements[0])
    with pytest.raises(ValueError, match="kappa"):
        UnscentedJacobian(kappa=-14.0).initial(measurements[0])


def test_a_nominal_jacobian_is_where_the_estimate_begins():
    measurements, jacobian = linear_world(np.random.default_rng(22), 3)
    prior = JacobianPrior(mean=tuple(map(tuple, jacobian.tolist())))
    for estimator in (KalmanJacobian(prior=prior), UnscentedJacobian(prior=prior), BroydenJacobian(prior=prior)):
        _, estimates = run(estimator, measurements)
        np.testing.assert_allclose(estimates[-1].jacobian, jacobian, rtol=1e-9)


def test_particles_do_not_depend_on_the_batch_but_on_the_seed():
    measurements, _ = linear_world(np.random.default_rng(23), 10, noise=0.5)
    first, again, other = (run(ParticleJacobian(particles=50, seed=s), measurements)[0].particles for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_alignment_is_a_parameter_of_every_estimator():
    for estimator in ESTIMATORS.values():
        assert dataclasses.replace(estimator, alignment=Alignment(latency=0.05)).alignment.latency == 0.05
