"""The default controller on worlds that are not ours: random linear ones, mixed units, features that come and go."""

import dataclasses

import numpy as np
import pytest

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    Alignment,
    AnyArm,
    Cautious,
    EstimatorBank,
    Exploration,
    FeatureWise,
    HypothesisBank,
    JacobianPrior,
    JointLimits,
    JointSpace,
    KalmanJacobian,
    Latencies,
    LinearEstimate,
    ProgressSupervisor,
    ServoController,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.adaptive import AdaptiveState
from servotrack.estimators.jacobian.bank import EstimatorBankState

PERIOD = 0.05


class LinearWorld:
    """Rows of worlds with y = A (q - q*) and goal 0; A and q* are random."""

    def __init__(self, joints, features=8, rows=1, seed=0, scale=300.0, noise=0.0, far=0.3):
        rng = np.random.default_rng(seed)
        self.jacobian = rng.normal(0.0, scale, (rows, features, joints))
        self.goal_joints = rng.uniform(-far, far, (rows, joints))
        self.joints, self.noise, self.rng, self.time = np.zeros((rows, joints)), noise, rng, 0.0
        self.visible = np.ones((rows, features), np.bool_)

    @property
    def error(self):
        return np.einsum("bij,bj->bi", self.jacobian, self.joints - self.goal_joints)

    def measurement(self):
        rows, features = self.visible.shape
        noise = self.noise * self.rng.normal(size=(rows, features))
        time = np.full(rows, self.time)
        return ServoMeasurement(
            self.joints.copy(), self.error + noise, np.zeros((rows, features)), self.visible.copy(), time, time
        )

    def step(self, rate):
        self.joints = self.joints + rate * PERIOD
        self.time += PERIOD


def served(controller, world, steps):
    """Joint rates, mean errors and exploring rows of all steps."""
    state, rates, errors, exploring = None, [], [], []
    for _ in range(steps):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
        rates.append(rate)
        errors.append(np.abs(world.error).mean(axis=-1))
        exploring.append(state.excitation.active)
    return np.array(rates), np.array(errors), np.array(exploring)


@pytest.mark.parametrize("joints", range(2, 9))
def test_random_linear_worlds_are_always_solved(joints):
    """As many features as joints, and more: all of 100 draws each."""
    for features in (joints, 8):
        _, errors, exploring = served(ServoController(), LinearWorld(joints, features, rows=100, seed=joints), 300)
        assert errors[-1].max() < 0.5
        # Frames at rest, then one or two moves of each joint.
        assert exploring.sum(axis=0).max() <= 8 + 2 * joints


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_noise_is_measured_and_leaves_an_error_of_its_own_size(noise):
    controller = ServoController()
    world = LinearWorld(6, rows=50, seed=1, noise=noise)
    _, errors, _ = served(controller, world, 300)
    assert np.mean(errors[-50:].mean(axis=0) < noise) >= 0.95
    state = controller.estimator.initial(world.measurement())
    for _ in range(40):
        state, estimate = controller.estimator.step(state, world.measurement())
        world.step(np.zeros((50, 6)))
    assert np.sqrt(np.median(estimate.error_variance)) == pytest.approx(noise, rel=0.1)


def test_an_arm_with_more_joints_than_the_image_tells_apart_does_not_drift():
    """Seven joints, a Jacobian of rank 6, half a pixel of noise, 90 s."""
    world = LinearWorld(7, rows=8, seed=2, noise=0.5)
    world.jacobian[..., 6] = world.jacobian[..., 5]
    state, controller = None, ServoController()
    angles = []
    for _ in range(1800):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
        angles.append(world.joints.copy())
    settled = np.array(angles)[300:]
    assert np.ptp(settled, axis=0).max() < 0.05
    assert np.abs(world.error).mean() < 0.5


def test_features_and_joints_may_have_other_units():
    """Meters instead of pixels, and a joint that slides by millimeters: the same rates."""
    plain, scaled = LinearWorld(3, 4, rows=5, seed=3, noise=0.5), LinearWorld(3, 4, rows=5, seed=3, noise=0.5)
    features, joints = np.array([1.0, 1e-3, 1.0, 50.0]), np.array([1.0, 1000.0, 1.0])
    controller = ServoController(
        AdaptiveKalmanJacobian(
            feature_range=tuple(1000.0 * features),
            feature_noise=tuple(0.5 * features),
            joint_unit=tuple(joints),
            alignment=Alignment(revolute=(True, False, True)),
        ),
        supervisor=None,
        max_joint_rate=1e9,
    )
    reference = dataclasses.replace(
        controller,
        estimator=AdaptiveKalmanJacobian(alignment=Alignment(revolute=(True, False, True))),
    )
    one, other = reference.estimator.initial(plain.measurement()), None
    rng = np.random.default_rng(0)
    for _ in range(40):
        seen = plain.measurement()
        same = seen._replace(joint_angles=seen.joint_angles * joints, features=seen.features * features)
        other = controller.estimator.initial(same) if other is None else other
        one, estimate = reference.estimator.step(one, seen)
        other, rescaled = controller.estimator.step(other, same)
        plain.step(rng.normal(0.0, 0.5, (5, 3)))
    expected = estimate.jacobian * features[:, None] / np.append(joints, 1.0)
    np.testing.assert_allclose(rescaled.jacobian, expected, rtol=1e-8)
    np.testing.assert_allclose(rescaled.nis, estimate.nis, rtol=1e-8)
    del scaled


def test_joints_without_an_effect_are_left_alone():
    world = LinearWorld(4, rows=4, seed=5, noise=0.5)
    world.jacobian[..., 2] = 0.0
    _, errors, exploring = served(ServoController(), world, 200)
    assert errors[-1].max() < 1.0
    assert exploring[60:].mean() < 0.1
    assert np.abs(world.joints[:, 2]).max() < 0.5


def test_half_of_the_features_at_the_start_suffice():
    """The others come into view later; what is hidden may be NaN."""
    world = LinearWorld(4, rows=20, seed=6, noise=0.5)
    world.visible[:, 4:] = False
    state, controller = None, ServoController()
    for k in range(300):
        if k == 100:
            world.visible[:] = True
        seen = world.measurement()
        seen.features[~seen.visible] = np.nan
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        assert np.isfinite(rate).all()
        world.step(rate)
    assert np.abs(world.error).mean(axis=-1).max() < 1.0


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
        (lambda: ProgressSupervisor(settled=0.0), "settled"),
        (lambda: AdaptiveKalmanJacobian(feature_range=0.0), "feature_range"),
        (lambda: AdaptiveKalmanJacobian(change=-1.0), "change"),
        (lambda: ServoController(period=0.0), "period"),
    ],
)
def test_bad_parameters_are_named(make, message):
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


def test_a_joint_outside_its_limits_only_moves_inward():
    limits = JointLimits((-1.0,), (1.0,))
    low, high = limits.bounds(np.array([1.05]), np.zeros(1), 2.0, PERIOD)
    assert high[0] == 0.0 and low[0] < 0.0


def test_a_goal_out_of_reach_does_not_keep_the_arm_exploring():
    """Eight features that two joints cannot all satisfy: explorations become rarer."""
    world = LinearWorld(2, rows=6, seed=13, noise=0.5)
    offset = np.random.default_rng(0).normal(0.0, 60.0, (6, 8))
    controller, state, exploring = ServoController(), None, []
    for _ in range(1600):
        seen = world.measurement()
        seen = seen._replace(features=seen.features + offset)
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
        exploring.append(state.excitation.active)
    share = np.array(exploring, np.float64)
    assert 0.0 < share[50:800].mean() < 0.25
    assert share[800:].mean() < 0.5 * share[50:800].mean()


def test_a_goal_that_moves_smoothly_is_followed_and_a_new_one_is_no_velocity():
    world = LinearWorld(3, 6, rows=2, seed=14)
    sway = np.random.default_rng(0).normal(0.0, 0.2, (2, 3))
    controller, state, errors = ServoController(), None, []
    for k in range(400):
        goal = np.einsum("bij,bj->bi", world.jacobian, sway * np.sin(0.8 * PERIOD * max(k - 100, 0)))
        seen = world.measurement()._replace(goal=goal)
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
        errors.append(np.abs(seen.features - goal).mean())
    assert np.mean(errors[-150:]) < 1.0
    estimator, seen = AdaptiveKalmanJacobian(), world.measurement()
    state, _ = estimator.step(estimator.initial(seen), seen)
    jump = seen._replace(time=seen.time + PERIOD, frame_time=seen.time + PERIOD, goal=seen.goal + 100.0)
    np.testing.assert_array_equal(estimator.step(state, jump)[1].jacobian[..., -1], 0.0)


@pytest.mark.parametrize("age", [0.0, 0.05, 0.1])
def test_encoders_of_unknown_age_are_found_by_a_bank(age):
    """Frames are fresh, encoder readings old, and no stamp says so."""
    world = LinearWorld(4, rows=10, seed=16, noise=0.5)
    bank = HypothesisBank(AdaptiveKalmanJacobian(), Latencies((0.0, 0.05), (0.0, 0.05, 0.1)))
    controller, state, past = ServoController(bank, max_joint_rate=1.0), None, []
    for _ in range(300):
        seen = world.measurement()
        past.append(seen.joint_angles)
        late = seen._replace(joint_angles=past[max(len(past) - 1 - round(age / PERIOD), 0)])
        state = controller.initial(late) if state is None else state
        state, rate = controller.step(state, late)
        world.step(rate)
    assert np.mean(np.abs(world.error).mean(axis=-1) < 1.0) >= 0.9
    best = state.estimator.log_weight.argmax(axis=-1)
    frames, encoders = np.repeat((0.0, 0.05), 3), np.tile((0.0, 0.05, 0.1), 2)
    assert np.mean(np.isclose((encoders - frames)[best], age)) >= 0.9


def test_the_play_of_gears_is_found_by_a_bank():
    world = LinearWorld(3, rows=10, seed=17, noise=0.5)
    members = tuple(AdaptiveKalmanJacobian(alignment=Alignment(play=play)) for play in (0.0, 0.02, 0.04))
    controller, state, links = ServoController(EstimatorBank(members), max_joint_rate=1.0), None, np.zeros((10, 3))
    for _ in range(300):
        links = np.clip(links, world.joints - 0.01, world.joints + 0.01)
        error = np.einsum("bij,bj->bi", world.jacobian, links - world.goal_joints)
        seen = world.measurement()._replace(features=error + world.rng.normal(0.0, 0.5, error.shape))
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
    assert np.mean(state.estimator.log_weight.argmax(axis=-1) == 1) >= 0.9
    assert np.mean(np.abs(error).mean(axis=-1) < 2.0) >= 0.9


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


def test_a_wrong_number_of_plays_is_named():
    with pytest.raises(ValueError, match="play must be one number or one per joint, got 2 for 3 joints"):
        Alignment(play=(0.0, 0.0)).initial(LinearWorld(3).measurement()._replace(visible=np.ones(1, np.bool_)))


def test_points_are_told_by_their_entries_of_visible():
    estimator, world = AnyArm(), LinearWorld(3, 8)
    seen = world.measurement()
    assert isinstance(estimator.initial(seen), AdaptiveState)
    assert isinstance(estimator.initial(seen._replace(visible=np.ones((1, 4), np.bool_))), EstimatorBankState)
    few = LinearWorld(3, 4).measurement()
    assert isinstance(estimator.initial(few._replace(visible=np.ones((1, 2), np.bool_))), AdaptiveState)


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


def test_a_prior_can_be_given_to_the_filter_of_each_feature():
    estimator = FeatureWise(KalmanJacobian(prior=JacobianPrior(joint_spread=900.0)))
    seen = LinearWorld(3, 4).measurement()
    assert estimator.initial(seen).rows.covariance.shape == (1, 4, 4, 4)
