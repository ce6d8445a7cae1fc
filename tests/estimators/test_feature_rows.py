"""Filters of single rows of the Jacobian: units, features that come and go, and the filter of all rows at once."""

import numpy as np
from linear_world import LinearWorld

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    Alignment,
    FeatureWise,
    JacobianPrior,
    KalmanJacobian,
    ServoController,
)


def test_features_and_joints_may_have_other_units():
    """Meters instead of pixels, and a joint that slides by millimeters: the same Jacobian."""
    plain = LinearWorld(3, 4, rows=5, seed=3, noise=0.5)
    features, joints = np.array([1.0, 1e-3, 1.0, 50.0]), np.array([1.0, 1000.0, 1.0])
    turning = Alignment(revolute=(True, False, True))
    reference = AdaptiveKalmanJacobian(alignment=turning)
    estimator = AdaptiveKalmanJacobian(
        feature_range=tuple(1000.0 * features),
        feature_noise=tuple(0.5 * features),
        joint_unit=tuple(joints),
        alignment=turning,
    )
    one, other = reference.initial(plain.measurement()), None
    rng = np.random.default_rng(0)
    for _ in range(40):
        seen = plain.measurement()
        same = seen._replace(joint_angles=seen.joint_angles * joints, features=seen.features * features)
        other = estimator.initial(same) if other is None else other
        one, estimate = reference.step(one, seen)
        other, rescaled = estimator.step(other, same)
        plain.step(rng.normal(0.0, 0.5, (5, 3)))
    expected = estimate.jacobian * features[:, None] / np.append(joints, 1.0)
    np.testing.assert_allclose(rescaled.jacobian, expected, rtol=1e-8)
    np.testing.assert_allclose(rescaled.nis, estimate.nis, rtol=1e-8)


def test_a_nan_among_seen_features_counts_as_unseen():
    world = LinearWorld(3, 4, rows=1, seed=7)
    controller = ServoController()
    state = controller.initial(world.measurement())
    for k in range(120):
        seen = world.measurement()
        if k % 3 == 0:
            seen.features[0, 1] = np.nan
        state, rate = controller.step(state, seen)
        world.step(rate)
    assert np.abs(world.error).max() < 0.1


def test_one_entry_for_all_features_equals_one_for_each():
    estimator, world = AdaptiveKalmanJacobian(), LinearWorld(2, 4, rows=3, seed=8, noise=0.5)
    rng, whole, single = np.random.default_rng(0), None, None
    for _ in range(20):
        seen = world.measurement()
        once = seen._replace(visible=np.ones(3, np.bool_))
        whole = estimator.initial(once) if whole is None else whole
        single = estimator.initial(seen) if single is None else single
        whole, one = estimator.step(whole, once)
        single, other = estimator.step(single, seen)
        np.testing.assert_array_equal(one.jacobian, other.jacobian)
        world.step(rng.normal(0.0, 0.5, (3, 2)))


def test_a_filter_of_each_feature_is_that_of_all_while_all_are_seen():
    plain, split = KalmanJacobian(), FeatureWise(KalmanJacobian())
    world, rng = LinearWorld(3, 4, rows=2, seed=9, noise=0.5), np.random.default_rng(0)
    a = b = None
    for _ in range(20):
        seen = world.measurement()
        a = plain.initial(seen._replace(visible=np.ones(2, np.bool_))) if a is None else a
        b = split.initial(seen) if b is None else b
        a, one = plain.step(a, seen._replace(visible=np.ones(2, np.bool_)))
        b, other = split.step(b, seen)
        np.testing.assert_allclose(other.jacobian, one.jacobian, rtol=1e-12)
        np.testing.assert_allclose(other.log_likelihood, one.log_likelihood, rtol=1e-12)
        np.testing.assert_allclose(other.nis, one.nis, rtol=1e-12)
        world.step(rng.normal(0.0, 0.5, (2, 3)))


def test_a_feature_that_comes_back_teaches_its_row_over_the_gap():
    estimator, world, state = FeatureWise(KalmanJacobian(measurement_noise=0.01)), LinearWorld(2, 2, seed=10), None
    rates = np.random.default_rng(0).normal(0.0, 0.8, (12, 1, 2))
    for k, rate in enumerate(rates):
        world.visible[:] = [[True, not 3 <= k < 7]]
        seen = world.measurement()
        state = estimator.initial(seen) if state is None else state
        state, estimate = estimator.step(state, seen)
        if k in (3, 4, 5, 6):
            # The hidden feature is predicted.
            np.testing.assert_allclose(estimate.error[0, 1], world.error[0, 1], atol=30.0)
        world.step(rate)
    np.testing.assert_allclose(estimate.jacobian[..., :2], world.jacobian, atol=10.0)


def test_a_prior_can_be_given_to_the_filter_of_each_feature():
    estimator = FeatureWise(KalmanJacobian(prior=JacobianPrior(joint_spread=900.0)))
    seen = LinearWorld(3, 4).measurement()
    assert estimator.initial(seen).rows.covariance.shape == (1, 4, 4, 4)
