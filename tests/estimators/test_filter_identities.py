"""What the Jacobian filters are to one another: equal on the linear model, or limits of each other."""

import numpy as np
import pytest
from linear_world import linear_world, run

from servotrack.estimators.jacobian import (
    CorrentropyNoise,
    FullKalmanJacobian,
    JacobianPrior,
    KalmanJacobian,
    LevelKalmanJacobian,
    RandomWalk,
    RecursiveLeastSquares,
    StudentTNoise,
    UnscentedJacobian,
)


@pytest.mark.parametrize("kappa", [-8.0, 0.0, 1.0, 3.0, 40.0])
def test_on_the_linear_model_an_unscented_filter_is_a_kalman_filter(kappa):
    walk, rng = RandomWalk(np.sqrt(31.6), np.sqrt(31.6)), np.random.default_rng(9)
    measurements, _ = linear_world(rng, 1000, batch=(3,), noise=1.0, dropped=0.1)
    _, kalman = run(KalmanJacobian(walk=walk, measurement_noise=10.0), measurements)
    _, unscented = run(UnscentedJacobian(walk=walk, measurement_noise=10.0, kappa=kappa), measurements)
    for a, b in zip(kalman, unscented, strict=True):
        scale = np.abs(a.jacobian).max() + 1.0
        assert np.abs(a.jacobian - b.jacobian).max() <= 1e-12 * scale
        np.testing.assert_allclose(a.log_likelihood, b.log_likelihood, rtol=1e-10, atol=1e-10)


def test_the_printed_filter_exchanges_the_two_noises():
    printed = UnscentedJacobian(walk=RandomWalk(2.0, 2.0), measurement_noise=7.0, as_printed=True)
    honest = UnscentedJacobian(walk=RandomWalk(7.0, 7.0), measurement_noise=2.0)
    measurements, _ = linear_world(np.random.default_rng(10), 50, noise=1.0)
    for a, b in zip(run(printed, measurements)[1], run(honest, measurements)[1], strict=True):
        np.testing.assert_array_equal(a.jacobian, b.jacobian)
    with pytest.raises(ValueError, match="joint_noise"):
        UnscentedJacobian(walk=RandomWalk(1.0, 2.0), as_printed=True)


@pytest.mark.parametrize(("n", "m"), [(2, 2), (3, 5)])
def test_one_covariance_for_all_rows_is_the_full_filter(n, m):
    measurements, _ = linear_world(np.random.default_rng(11), 300, batch=(2,), n=n, m=m, noise=1.0, dropped=0.1)
    shared_state, shared = run(KalmanJacobian(), measurements)
    full_state, full = run(FullKalmanJacobian(measurement_covariance=9.0), measurements)
    for a, b in zip(shared, full, strict=True):
        np.testing.assert_allclose(a.jacobian, b.jacobian, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(a.log_likelihood, b.log_likelihood, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(a.nis, b.nis, rtol=1e-8, atol=1e-12)
    expected = np.kron(np.eye(m), shared_state.covariance[0])
    np.testing.assert_allclose(full_state.covariance[0], expected, rtol=1e-8, atol=1e-8)


def test_the_full_filter_trusts_the_better_feature():
    measurements, jacobian = linear_world(np.random.default_rng(12), 40, batch=(50,))
    noise = np.random.default_rng(13).normal(0, 1, (40, 50, 2)) * [0.1, 5.0]
    noisy = [each._replace(features=each.features + e) for each, e in zip(measurements, noise, strict=True)]
    state, estimates = run(FullKalmanJacobian(measurement_covariance=((0.02, 0.0), (0.0, 50.0))), noisy)
    error = np.sqrt(np.mean((estimates[-1].jacobian - jacobian) ** 2, axis=(0, 2)))
    assert error[0] < 0.3 * error[1]
    variances = np.einsum("bii->bi", state.covariance)
    assert (variances[:, :3] < variances[:, 3:]).all()


def test_least_squares_without_forgetting_is_a_kalman_filter_of_a_constant():
    measurements, _ = linear_world(np.random.default_rng(14), 100, batch=(2,), noise=1.0)
    prior = JacobianPrior()
    state, _ = run(RecursiveLeastSquares(forgetting=1.0, measurement_noise=2.0, prior=prior), measurements)
    constant, _ = run(KalmanJacobian(walk=RandomWalk(0.0, 0.0), measurement_noise=2.0, prior=prior), measurements)
    np.testing.assert_allclose(state.jacobian, constant.jacobian, rtol=1e-12)
    np.testing.assert_allclose(state.covariance, constant.covariance, rtol=1e-12)


def test_forgetting_does_not_wind_up_while_the_arm_rests():
    estimator = RecursiveLeastSquares(forgetting=0.7)
    at_rest, _ = linear_world(np.random.default_rng(15), 3000, noise=0.5, motion=0.0)
    state, _ = run(estimator, at_rest)
    limit = estimator.prior.deviations(2) ** 2
    assert (np.diag(state.covariance) <= limit * (1 + 1e-9)).all()


@pytest.mark.parametrize("outliers", [StudentTNoise(), CorrentropyNoise()], ids=["student-t", "correntropy"])
@pytest.mark.parametrize("make", [KalmanJacobian, LevelKalmanJacobian])
def test_an_outlier_moves_a_robust_filter_less(make, outliers):
    measurements, _ = linear_world(np.random.default_rng(16), 60, batch=(20,), noise=0.5)
    spoiled = measurements[-1]._replace(features=measurements[-1].features + 60.0)
    moved = []
    for estimator in (make(), make(outliers=outliers)):
        state, estimates = run(estimator, measurements[:-1])
        _, estimate = estimator.step(state, spoiled)
        moved.append(np.abs(estimate.jacobian - estimates[-1].jacobian).max())
    assert moved[1] < 0.3 * moved[0]


@pytest.mark.parametrize("outliers", [StudentTNoise(1e9), CorrentropyNoise(1e9)], ids=["student-t", "correntropy"])
def test_the_limit_of_a_robust_filter_is_the_kalman_filter(outliers):
    measurements, _ = linear_world(np.random.default_rng(17), 60, noise=2.0)
    plain, robust = (run(KalmanJacobian(outliers=each), measurements)[0] for each in (None, outliers))
    np.testing.assert_allclose(plain.jacobian, robust.jacobian, rtol=1e-6, atol=1e-6)


def test_the_level_filter_is_calmer_than_the_pixels():
    """Filtering the level is the point: its error estimate is better than the raw pixel's."""
    measurements, _ = linear_world(np.random.default_rng(18), 200, batch=(50,), motion=0.01)
    noise = np.random.default_rng(19).normal(0, 2.0, (200, 50, 2))
    noisy = [each._replace(features=each.features + e) for each, e in zip(measurements, noise, strict=True)]
    estimator = LevelKalmanJacobian(walk=RandomWalk(1.0, 1.0), pixel_noise=2.0, curvature_noise=0.05)
    _, estimates = run(estimator, noisy)
    left = estimates[-1].error - measurements[-1].features
    assert np.sqrt(np.mean(left**2)) < 0.7 * 2.0
