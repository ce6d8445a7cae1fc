"""The default controller on worlds that are not ours: random linear ones, late clocks, play, goals that move."""

import numpy as np
import pytest
from linear_world import PERIOD, LinearWorld, served

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    Alignment,
    AnyArm,
    EstimatorBank,
    HypothesisBank,
    Latencies,
    ProgressSupervisor,
    ServoController,
)
from servotrack.estimators.jacobian.adaptive import AdaptiveState
from servotrack.estimators.jacobian.bank import EstimatorBankState


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


def test_an_arm_that_turns_on_and_on_without_progress_explores():
    """Four joints whose encoders show the way, and features that do not follow it: 3 rad, however patient."""
    world, supervisor = LinearWorld(4, rows=2, seed=18), ProgressSupervisor(patience=10_000)
    controller, state = ServoController(supervisor=supervisor, max_joint_rate=2.0), None
    turned, begun = np.zeros((2, 4)), None
    for _ in range(400):
        seen = world.measurement()
        if begun is not None:
            seen = seen._replace(features=np.full((2, 8), 200.0) + world.rng.normal(0.0, 0.1, (2, 8)))
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        if begun is not None and state.excitation.active.any():
            break
        begun = True if begun is None and not state.excitation.active.any() else begun
        turned += PERIOD * np.abs(rate) if begun else 0.0
        world.step(rate)
    assert state.excitation.active.any()
    assert 2.5 < turned.max() < 3.5


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


def test_points_are_told_by_their_entries_of_visible():
    estimator, world = AnyArm(), LinearWorld(3, 8)
    seen = world.measurement()
    assert isinstance(estimator.initial(seen), AdaptiveState)
    assert isinstance(estimator.initial(seen._replace(visible=np.ones((1, 4), np.bool_))), EstimatorBankState)
    few = LinearWorld(3, 4).measurement()
    assert isinstance(estimator.initial(few._replace(visible=np.ones((1, 2), np.bool_))), AdaptiveState)
