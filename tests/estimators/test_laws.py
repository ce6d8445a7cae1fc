"""Control laws: the right motion where the Jacobian allows it, a bounded one where it does not."""

from dataclasses import dataclass

import numpy as np
import pytest

from servotrack.estimators.jacobian import (
    DampedLeastSquares,
    LinearEstimate,
    OneStepExact,
    Proportional,
    ProportionalIntegral,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.laws import damped_inverse, limiting_factor

PERIOD = 0.05
LAWS = {
    "proportional": Proportional(),
    "pi": ProportionalIntegral(),
    "damped": DampedLeastSquares(),
    "one-step": OneStepExact(),
}
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


def linear(error, jacobian):
    silent = np.zeros(np.shape(error)[:-1])
    return LinearEstimate(np.asarray(error, float), np.asarray(jacobian, float), silent, silent)


def first_rate(law, estimate):
    batch, n = estimate.jacobian.shape[:-2], estimate.jacobian.shape[-1] - 1
    blank = ServoMeasurement(
        np.zeros((*batch, n)),
        estimate.error,
        np.zeros_like(estimate.error),
        np.ones(batch, bool),
        *np.zeros((2, *batch)),
    )
    return law.rate(law.initial(blank), estimate)[1]


@dataclass(frozen=True)
class TurningEstimate(LinearEstimate):
    """Knows that the features turn with the second joint."""

    def predict_error(self, joint_motion, duration):
        c, s = np.cos(joint_motion[..., 1]), np.sin(joint_motion[..., 1])
        moved = super().predict_error(joint_motion, duration)
        return np.stack([c * moved[..., 0] - s * moved[..., 1], s * moved[..., 0] + c * moved[..., 1]], axis=-1)


@pytest.mark.parametrize("law", [Proportional(gain=0.6), OneStepExact(gain=0.6)])
def test_the_fraction_lambda_of_the_error_is_gone_after_one_period(law):
    rng = np.random.default_rng(1)
    estimate = linear(rng.normal(0, 5, (20, 2)), rng.normal(0, 50, (20, 2, 3)) + 400 * np.eye(2, 3))
    rate = first_rate(law, estimate)
    np.testing.assert_allclose(estimate.predict_error(rate * PERIOD, PERIOD), 0.4 * estimate.error, atol=1e-9)


def test_one_step_exact_is_exact_where_the_jacobian_is_not():
    estimate = TurningEstimate(
        np.array([12.0, -9.0]), np.array([[300.0, 50.0, 20.0], [-40.0, 250.0, -30.0]]), *[np.zeros(())] * 2
    )
    exact = estimate.predict_error(first_rate(OneStepExact(gain=0.9), estimate) * PERIOD, PERIOD)
    linearized = estimate.predict_error(first_rate(Proportional(gain=0.9), estimate) * PERIOD, PERIOD)
    wanted = 0.1 * estimate.error
    assert np.abs(exact - wanted).max() < 1e-3 < np.abs(linearized - wanted).max()


def test_one_step_exact_approaches_a_far_goal_within_its_step():
    estimate = linear([400.0, 300.0], [[300.0, 0.0, 0.0], [0.0, 300.0, 0.0]])
    motion = first_rate(OneStepExact(max_step=0.1), estimate) * PERIOD
    np.testing.assert_allclose(motion, [-0.1, -0.075], atol=1e-12)


@every_law
def test_a_feature_count_other_than_the_joint_count_is_served(law):
    rng = np.random.default_rng(2)
    for n, m in ((3, 2), (2, 4), (1, 2)):
        estimate = linear(rng.normal(0, 5, (6, m)), rng.normal(0, 300, (6, m, n + 1)))
        rate = first_rate(law, estimate)
        assert rate.shape == (6, n)
        assert np.isfinite(rate).all()
    wide = linear([10.0, 5.0], [[200.0, 0.0, 100.0, 0.0], [0.0, 200.0, 100.0, 0.0]])
    by_joints = wide.jacobian[:, :-1]
    expected = np.linalg.pinv(by_joints) @ (-0.6 * wide.error) / PERIOD
    np.testing.assert_allclose(first_rate(Proportional(gain=0.6), wide), expected, atol=1e-10)


@every_law
@pytest.mark.parametrize(
    "jacobian",
    [
        np.zeros((2, 3)),
        [[300.0, 300.0, 0.0], [100.0, 100.0, 0.0]],
        [[300.0, 300.0 + 1e-7, 0.0], [100.0, 100.0, 0.0]],
        [[1e-200, 0.0, 0.0], [0.0, 1e-200, 0.0]],
        [[300.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    ],
    ids=["zero", "rank one", "nearly rank one", "tiny", "stretched"],
)
def test_a_singular_jacobian_gives_no_nan(law, jacobian):
    rate = first_rate(law, linear([30.0, -50.0], jacobian))
    assert np.isfinite(rate).all()


def test_a_near_singularity_gives_no_leap():
    estimate = linear([30.0, -50.0], [[300.0, 300.0 + 1e-3, 0.0], [100.0, 100.0, 0.0]])
    motion = first_rate(Proportional(), estimate) * PERIOD
    assert np.abs(motion).max() < 1.0


def test_the_damped_inverse_is_exact_where_it_is_well_conditioned():
    matrices = np.random.default_rng(3).normal(0, 50, (50, 2, 2)) + 300 * np.eye(2)
    np.testing.assert_allclose(damped_inverse(matrices, 0.03), np.linalg.inv(matrices), rtol=1e-9)
    assert (damped_inverse(np.full((2, 2), np.nan), 0.03) == 0.0).all()


def test_the_integral_removes_what_an_unknown_drift_leaves():
    jacobian = np.array([[300.0, 0.0, 0.0], [0.0, 300.0, 0.0]])
    left = {}
    for name, law in (("P", Proportional()), ("PI", ProportionalIntegral(integral_gain=2.0))):
        blank = ServoMeasurement(np.zeros(2), np.zeros(2), np.zeros(2), np.asarray(True), np.zeros(()), np.zeros(()))
        state, error = law.initial(blank), np.array([20.0, -10.0])
        for _ in range(300):
            state, rate = law.rate(state, linear(error, jacobian))
            error = error + jacobian[:, :2] @ rate * PERIOD + np.array([1.0, 2.0])
        left[name] = np.abs(error).max()
    assert left["PI"] < 0.05 * left["P"]


def test_the_integral_does_not_wind_up():
    law = ProportionalIntegral(integral_limit=3.0)
    state = law.initial(ServoMeasurement(*[np.zeros(2)] * 3, np.asarray(True), np.zeros(()), np.zeros(())))
    for _ in range(100):
        state, _ = law.rate(state, linear([500.0, -500.0], np.eye(2, 3)))
    np.testing.assert_array_equal(state.integral, [3.0, -3.0])


def test_the_limit_keeps_the_direction():
    motion = np.array([[0.3, -0.1], [0.01, 0.02], [0.0, 0.0]])
    limited = limiting_factor(motion, 0.1) * motion
    np.testing.assert_allclose(limited, [[0.1, -0.1 / 3], [0.01, 0.02], [0.0, 0.0]], atol=1e-15)


@every_law
def test_a_row_of_a_batch_is_what_it_is_alone(law):
    rng = np.random.default_rng(4)
    estimate = linear(rng.normal(0, 30, (3, 4, 2)), rng.normal(0, 300, (3, 4, 2, 3)))
    rates = first_rate(law, estimate)
    for row in np.ndindex(3, 4):
        np.testing.assert_array_equal(rates[row], first_rate(law, linear(estimate.error[row], estimate.jacobian[row])))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Proportional(gain=0.0), "gain"),
        (lambda: Proportional(period=-1.0), "period"),
        (lambda: Proportional(damping=np.nan), "damping"),
        (lambda: ProportionalIntegral(integral_limit=-1.0), "integral_limit"),
        (lambda: DampedLeastSquares(damping=0.0), "damping"),
        (lambda: OneStepExact(iterations=0), "iterations"),
        (lambda: OneStepExact(max_step=0.0), "max_step"),
    ],
)
def test_impossible_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
