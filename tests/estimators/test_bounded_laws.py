"""Laws that bound their risk and keep joint limits, and the parameters of the parts of a servo."""

import dataclasses

import numpy as np
import pytest
from linear_world import PERIOD, LinearWorld

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    Alignment,
    Cautious,
    EstimatorBank,
    Exploration,
    JointLimits,
    JointSpace,
    KalmanJacobian,
    Latencies,
    LinearEstimate,
    ProgressSupervisor,
    ServoController,
    ServoMeasurement,
)


def exact(jacobian, deviation=1.0, error=None, noise=0.5):
    """Estimate with a known Jacobian."""
    m, n = jacobian.shape
    return LinearEstimate(
        error=np.full(m, 50.0) if error is None else error,
        jacobian=np.column_stack([jacobian, np.zeros(m)]),
        log_likelihood=np.zeros(()),
        nis=np.zeros(()),
        covariance=np.tile(np.diag([deviation**2] * n + [1.0]), (m, 1, 1)),
        error_variance=np.full(m, noise**2),
        goal_velocity=np.zeros(m),
    )


def test_a_certain_estimate_is_inverted():
    rng = np.random.default_rng(0)
    jacobian = rng.normal(0.0, 300.0, (8, 5))
    law = Cautious(gain=0.3)
    wanted = rng.normal(0.0, 0.1, 5)
    estimate = exact(jacobian, 1e-3, -jacobian @ wanted)
    rate = law.rate(law.initial(ServoMeasurement(*[np.zeros(5), np.zeros(8), np.zeros(8)], True, 0.0, 0.0)), estimate)[
        1
    ]
    np.testing.assert_allclose(rate * law.period, 0.3 * wanted, rtol=1e-6)


def test_a_velocity_counts_in_full_where_it_is_given_and_else_as_far_as_it_is_significant():
    """The goal's velocity is known; the same velocity of the target is an estimate, here with a larger deviation."""
    rng = np.random.default_rng(4)
    jacobian, wanted = rng.normal(0.0, 300.0, (8, 5)), rng.normal(0.0, 0.005, 5)
    still = exact(jacobian, 1e-3, np.zeros(8))
    still.covariance[:, -1, -1] = 5.0**2
    law = Cautious()
    begin = law.initial(ServoMeasurement(np.zeros(5), np.zeros(8), np.zeros(8), True, 0.0, 0.0))
    moved = still.jacobian.copy()
    moved[:, -1] = -jacobian @ wanted
    assert np.abs(moved[:, -1]).max() < 5.0
    by_goal = dataclasses.replace(still, jacobian=moved, goal_velocity=jacobian @ wanted)
    np.testing.assert_allclose(law.rate(begin, by_goal)[1], wanted, rtol=1e-6)
    by_itself = dataclasses.replace(still, jacobian=moved)
    assert np.abs(law.rate(begin, by_itself)[1]).max() < 0.01 * np.abs(wanted).max()


def test_the_risk_of_a_motion_is_bounded():
    rng = np.random.default_rng(1)
    law, jacobian = Cautious(), rng.normal(0.0, 300.0, (8, 6))
    jacobian[:, 5] = 0.2 * rng.normal(size=8)
    estimate = exact(jacobian, 20.0, rng.normal(0.0, 100.0, 8))
    state = law.initial(ServoMeasurement(np.zeros(6), np.zeros(8), np.zeros(8), True, 0.0, 0.0))
    motion = law.rate(state, estimate)[1] * law.period
    risk = 8 * 20.0**2 * motion @ motion
    allowed = max(law.risk * law.gain * np.linalg.norm(estimate.error), 3.0 * 0.5 * np.sqrt(8))
    assert risk <= 1.01 * allowed**2


def test_a_law_in_joint_space_goes_straight_where_the_goal_is_found():
    """The estimate knows the motion; a second row knows none, and a third one that leaves too much."""

    @dataclasses.dataclass(frozen=True)
    class Searching(LinearEstimate):
        motion: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))

        def motion_to_goal(self, low=None, high=None):
            return np.clip(self.motion, low, high), np.array([0.1, np.inf, 40.0])

    rng = np.random.default_rng(0)
    jacobian = rng.normal(0.0, 300.0, (4, 2))
    one = exact(jacobian, 1e-3)
    rows = {field.name: np.stack([getattr(one, field.name)] * 3) for field in dataclasses.fields(one)}
    estimate = Searching(**rows, motion=np.array([[0.4, -0.2]] * 3))
    law = JointSpace(gain=0.5)
    seen = ServoMeasurement(*[np.zeros((3, k)) for k in (2, 4, 4)], np.ones(3, np.bool_), np.zeros(3), np.zeros(3))
    state = law.initial(seen)
    _, rate = law.rate(state, estimate, np.full((3, 2), -1.0), np.full((3, 2), 0.3))
    _, in_the_image = law.image.rate(state, LinearEstimate(**rows))
    np.testing.assert_allclose(rate[0] * law.period, [0.15, -0.1])
    np.testing.assert_array_equal(rate[1:], in_the_image[1:])


@pytest.mark.parametrize("rows", [1, 4])
def test_joint_limits_and_accelerations_are_never_exceeded(rows):
    world = LinearWorld(5, rows=rows, seed=11, noise=0.5, far=1.0)
    limits = JointLimits((-0.6,) * 5, (0.7,) * 5, margin=0.02, max_acceleration=4.0)
    controller = ServoController(max_joint_rate=1.0, limits=limits)
    state, before = None, np.zeros((rows, 5))
    for _ in range(400):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        assert np.abs(rate).max() <= 1.0 + 1e-12
        assert np.abs(rate - before).max() <= 4.0 * PERIOD + 1e-9
        world.step(rate)
        before = rate
        assert world.joints.min() >= -0.6 and world.joints.max() <= 0.7


def test_bounds_share_the_motion_among_the_other_joints():
    """A joint that may not move leaves a redundant arm that can still serve."""
    rng = np.random.default_rng(12)
    jacobian = rng.normal(0.0, 300.0, (3, 5))
    law, estimate = Cautious(), exact(jacobian, 1e-3, np.array([30.0, -20.0, 10.0]))
    state = law.initial(ServoMeasurement(np.zeros(5), np.zeros(3), np.zeros(3), True, 0.0, 0.0))
    rate = law.rate(state, estimate)[1]
    low, high = np.full(5, -1.0), np.full(5, 1.0)
    low[1] = high[1] = 0.0
    bounded = law.within(rate, estimate, low, high, np.array(True))
    assert abs(bounded[1]) < 1e-8
    np.testing.assert_allclose(jacobian @ bounded, jacobian @ rate, rtol=1e-3, atol=1.0)


def test_a_joint_outside_its_limits_only_moves_inward():
    limits = JointLimits((-1.0,), (1.0,))
    low, high = limits.bounds(np.array([1.05]), np.zeros(1), 2.0, PERIOD)
    assert high[0] == 0.0 and low[0] < 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: JointLimits((0.0,), (0.0,)), "low must be below high"),
        (lambda: JointLimits((0.0, 0.0), (1.0,)), "one entry per joint"),
        (lambda: JointLimits((0.0,), (1.0,), max_acceleration=0.0), "max_acceleration"),
        (lambda: JointLimits((0.0,), (1.0,), margin=-0.1), "margin"),
        (lambda: Cautious(gain=0.0), "gain"),
        (lambda: Cautious(integral_gain=-1.0), "integral_gain"),
        (lambda: Cautious(risk=0.0), "risk"),
        (lambda: Exploration(most_moves=0), "most_moves"),
        (lambda: Exploration(signal=np.inf), "signal"),
        (lambda: Exploration(resting=-1), "resting"),
        (lambda: ProgressSupervisor(patience=0), "patience"),
        (lambda: ProgressSupervisor(progress=1.0), "progress"),
        (lambda: ProgressSupervisor(max_excursion=0.0), "max_excursion"),
        (lambda: ProgressSupervisor(settled=0.0), "settled"),
        (lambda: AdaptiveKalmanJacobian(feature_range=0.0), "feature_range"),
        (lambda: AdaptiveKalmanJacobian(change=-1.0), "change"),
        (lambda: ServoController(period=0.0), "period"),
    ],
)
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EstimatorBank(()), "members must have at least one"),
        (lambda: EstimatorBank((KalmanJacobian(),), forgetting=0.0), "forgetting"),
        (lambda: Latencies(encoder_ages=()), "encoder_ages"),
        (lambda: Alignment(play=-0.1), "play"),
        (lambda: JointSpace(gain=0.0), "gain"),
        (lambda: JointSpace(share=-1.0), "share"),
    ],
)
def test_bad_parameters_of_banks_and_laws_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_bad_inputs_are_named():
    seen = LinearWorld(3, 4).measurement()
    with pytest.raises(ValueError, match=r"feature_range must be one number or one per feature, got 2 for 4"):
        AdaptiveKalmanJacobian(feature_range=(1.0, 1.0)).initial(seen)
    with pytest.raises(ValueError, match=r"visible must have one entry, one per feature, or one per group"):
        AdaptiveKalmanJacobian().initial(seen._replace(visible=np.ones((1, 3), np.bool_)))
    with pytest.raises(ValueError, match=r"joint_angles must lie within the limits, got 2.0 .* joint 1 has \[-1, 1\]"):
        ServoController(limits=JointLimits((-1.0,) * 3, (1.0,) * 3)).initial(
            seen._replace(joint_angles=np.array([[0.0, 2.0, 0.0]]))
        )
    with pytest.raises(ValueError, match="limits must have one entry per joint, got 2"):
        ServoController(limits=JointLimits((-1.0,) * 2, (1.0,) * 2)).initial(seen)
    law = Cautious()
    with pytest.raises(ValueError, match="estimate must have covariance"):
        bare = LinearEstimate(np.zeros((1, 4)), np.zeros((1, 4, 4)), np.zeros(1), np.zeros(1))
        law.rate(law.initial(seen), bare)


def test_a_wrong_number_of_plays_is_named():
    with pytest.raises(ValueError, match="play must be one number or one per joint, got 2 for 3 joints"):
        Alignment(play=(0.0, 0.0)).initial(LinearWorld(3).measurement()._replace(visible=np.ones(1, np.bool_)))
