"""Chains: exact derivatives, exact identification, both mountings of the camera, batches, unseen points, refusals."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from estimator_zoo import UnseenInputs
from scipy.linalg import expm

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    ChainJacobian,
    HypothesisBank,
    Latencies,
    OneStepExact,
    ServoEstimate,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.chain_kernel import chain_derivatives, chain_features, jacobian_derivatives
from servotrack.estimators.testing import check_estimator

PERIOD = 0.05
FOCAL, CENTER = 650.0, np.array([335.0, 228.0])


class ChainWorld:
    """An arm of random joint axes with a camera in the hand or in the world, at rest; units are m and px."""

    def __init__(self, rng, joints, camera, points=4):
        axes = rng.normal(size=(joints, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        lines = rng.uniform(-0.7, 0.7, (joints, 3))
        self.screws = np.concatenate([axes, np.cross(lines, axes)], axis=1)
        self.camera, self.points = camera, points
        # The points in the camera's frame at angles 0, which is the frame of the screws too.
        spread = rng.uniform(-0.12, 0.12, (points, 2))
        self.board = np.column_stack([spread, rng.uniform(0.45, 0.6, points), np.ones(points)])

    def features(self, angles):
        pose = np.eye(4)
        for k in range(len(angles)) if self.camera == "world" else reversed(range(len(angles))):
            (a, b, c), v = self.screws[k, :3], self.screws[k, 3:]
            twist = np.zeros((4, 4))
            twist[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
            twist[:3, 3] = v
            pose = pose @ expm((angles[k] if self.camera == "world" else -angles[k]) * twist)
        seen = (pose @ self.board.T).T
        return (FOCAL * seen[:, :2] / seen[:, 2:3] + CENTER).ravel()

    def jacobian(self, angles, step=1e-4):
        columns = []
        for k in range(len(angles)):
            unit = np.eye(len(angles))[k]

            def central(h, unit=unit):
                return (self.features(angles + h * unit) - self.features(angles - h * unit)) / (2 * h)

            columns.append((4.0 * central(step / 2) - central(step)) / 3.0)
        return np.array(columns).T


def walk(rng, joints, steps, size=0.08, first=0.04):
    """Joint angles: each joint moves alone and back, then all move at random about their first angles."""
    angles = [np.zeros(joints)]
    for k in range(joints):
        angles += [first * np.eye(joints)[k], np.zeros(joints)]
    while len(angles) < steps:
        angles.append(0.9 * angles[-1] + size * rng.uniform(-1.0, 1.0, joints))
    return np.array(angles[:steps])


def measure(angles, features, t, visible=True, goal=None):
    goal = np.full(np.shape(features), 240.0) if goal is None else goal
    batch = np.shape(angles)[:-1]
    time = np.full(batch, t * PERIOD)
    return ServoMeasurement(angles, features, goal, np.broadcast_to(visible, (*batch, *np.shape(visible))), time, time)


def drive(estimator, world, angles, rng=None, noise=0.0, visible=None):
    state, estimates = None, []
    for t, each in enumerate(angles):
        features = world.features(each)
        if noise:
            features = features + rng.normal(0.0, noise, features.shape)
        measurement = measure(each, features, t, True if visible is None else visible[t])
        state = estimator.initial(measurement) if state is None else state
        state, estimate = estimator.step(state, measurement)
        estimates.append(estimate)
    return state, estimates


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("angle", [1e-4, 0.1, 1.5])
def test_derivatives_equal_finite_differences(reverse, angle):
    rng = np.random.default_rng(3)
    n, p = 6, 4
    parameters = np.concatenate([rng.normal(0.0, 0.5, 6 * n), np.zeros(3 * p), [0.1, 0.02, -0.03]])
    parameters[6 * n : -3] = (rng.normal(0.0, 0.1, (p, 3)) + np.array([0.0, 0.0, 3.0])).ravel()
    angles = angle * rng.uniform(0.3, 1.0, n) * rng.choice([-1.0, 1.0], n)

    def features(parameters, angles):
        out = np.zeros(2 * p)
        chain_features(parameters, angles, reverse, 600.0, out)
        return out

    def differences(function, at):
        def central(k, h):
            step = h * np.eye(len(at))[k]
            return (function(at + step) - function(at - step)) / (2.0 * h)

        return np.array([(4.0 * central(k, 5e-4) - central(k, 1e-3)) / 3.0 for k in range(len(at))]).T

    value, by_angles, by_parameters = np.zeros(2 * p), np.zeros((2 * p, n)), np.zeros((2 * p, len(parameters)))
    chain_derivatives(parameters, angles, reverse, 600.0, value, by_angles, by_parameters)
    np.testing.assert_allclose(value, features(parameters, angles), rtol=1e-12)
    for ours, theirs in (
        (by_angles, differences(lambda q: features(parameters, q), angles)),
        (by_parameters, differences(lambda x: features(x, angles), parameters)),
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-6 * np.abs(theirs).max())

    def jacobian(parameters):
        found = np.zeros((2 * p, n))
        chain_derivatives(parameters, angles, reverse, 600.0, np.zeros(2 * p), found, np.zeros((0, len(parameters))))
        return found.T.ravel()

    shown, slopes, columns = np.zeros(2 * p), np.zeros((2 * p, n)), np.zeros((len(parameters), 2 * p * (n + 1)))
    jacobian_derivatives(parameters, angles, reverse, 600.0, shown, slopes, columns)
    np.testing.assert_allclose(shown, value, rtol=1e-12)
    np.testing.assert_allclose(slopes, by_angles, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(columns[:, 2 * p * n :].T, by_parameters, rtol=1e-9, atol=1e-9)
    theirs = differences(jacobian, parameters).T
    np.testing.assert_allclose(columns[:, : 2 * p * n], theirs, atol=1e-6 * np.abs(theirs).max())


@pytest.mark.parametrize("camera", ["hand", "world"])
@pytest.mark.parametrize("joints", [5, 6, 7])
def test_exact_data_of_a_random_chain_are_predicted_exactly(camera, joints):
    rng = np.random.default_rng(joints)
    world = ChainWorld(rng, joints, camera)
    angles = walk(rng, joints, 120)
    # The goal of these frames is a corner: it does not tell where the middle of the image is.
    estimator = ChainJacobian(center=(320.0, 240.0), noise=0.03, least_noise=1e-5)
    _, estimates = drive(estimator, world, angles)
    last = estimates[-1]
    assert last.chained.all()
    assert bool(last.reverse) == (camera == "hand")
    np.testing.assert_allclose(last.error, world.features(angles[-1]) - 240.0, atol=1e-6)
    true = world.jacobian(angles[-1])
    np.testing.assert_allclose(last.jacobian[:, :-1], true, atol=1e-6 * np.abs(true).max())
    # The prediction of a large motion, for laws such as `OneStepExact`.
    motion = rng.uniform(-0.15, 0.15, joints)
    np.testing.assert_allclose(
        last.predict_error(motion, PERIOD), world.features(angles[-1] + motion) - 240.0, atol=1e-5
    )
    focal = last.focal * np.exp(last.parameters[-3])
    assert focal == pytest.approx(FOCAL, rel=1e-6)


@pytest.mark.parametrize("camera", ["hand", "world"])
def test_with_noise_errors_agree_with_their_covariances(camera):
    errors, rows, scores, deviations = [], [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        world = ChainWorld(rng, 6, camera)
        angles = walk(rng, 6, 130)
        _, estimates = drive(ChainJacobian(center=(320.0, 240.0)), world, angles, rng, noise=1.0)
        last = estimates[-1]
        assert last.chained.all()
        errors.append((last.error + 240.0 - world.features(angles[-1])) ** 2 / last.error_variance)
        wrong = last.jacobian[:, :-1] - world.jacobian(angles[-1])
        inverse = np.linalg.inv(last.covariance[:, :-1, :-1])
        rows.append(np.einsum("mi,mij,mj->m", wrong, inverse, wrong) / 6.0)
        scores += [each.nis for each in estimates[60:]]
        deviations.append(np.sqrt(last.error_variance).mean())
    # Averaged over all frames: far below the noise of one.
    assert np.mean(deviations) < 0.5
    assert 0.5 < np.mean(errors) < 1.7
    assert 0.6 < np.mean(rows) < 1.4
    assert 0.9 < np.mean(scores) < 1.1


def test_the_chain_is_better_than_the_linear_filter():
    rng = np.random.default_rng(5)
    world = ChainWorld(rng, 7, "hand")
    angles = walk(rng, 7, 80)
    estimator = ChainJacobian()
    _, chain = drive(estimator, world, angles, np.random.default_rng(1), noise=2.0)
    _, linear = drive(estimator.linear, world, angles, np.random.default_rng(1), noise=2.0)
    true = world.jacobian(angles[-1])

    def wrong(estimate):
        return np.linalg.norm(estimate.jacobian[:, :-1] - true) / np.linalg.norm(true)

    assert wrong(chain[-1]) < 0.1
    assert wrong(chain[-1]) < 0.3 * wrong(linear[-1])


def test_unseen_points_are_predicted():
    rng = np.random.default_rng(8)
    world = ChainWorld(rng, 6, "world")
    angles = walk(rng, 6, 90)
    visible = np.ones((90, 4), np.bool_)
    visible[:12, 3] = False
    visible[60:, 0] = False
    estimator = ChainJacobian(least_noise=1e-3)
    _, estimates = drive(estimator, world, angles, visible=visible)
    # A point that was never seen has no error and no row yet.
    assert np.isinf(estimates[11].error_variance[6:]).all()
    assert (estimates[11].error[6:] == 0.0).all() and (estimates[11].jacobian[6:] == 0.0).all()
    last = estimates[-1]
    assert last.chained.all() and np.isfinite(last.error_variance).all()
    np.testing.assert_allclose(last.error, world.features(angles[-1]) - 240.0, atol=1e-3)


def test_outliers_are_down_weighted():
    rng = np.random.default_rng(2)
    world = ChainWorld(rng, 6, "hand")
    angles = walk(rng, 6, 100)
    clean = world.features

    def spoiled(q):
        out = clean(q) + rng.normal(0.0, 0.5, 8)
        if rng.random() < 0.1:
            out[2 * rng.integers(4)] += rng.choice([-1.0, 1.0]) * 80.0
        return out

    world.features = spoiled
    _, estimates = drive(ChainJacobian(), world, angles)
    assert estimates[-1].chained.all()
    np.testing.assert_allclose(estimates[-1].error, clean(angles[-1]) - 240.0, atol=2.0)


def test_a_moving_target_is_left_to_the_linear_filter():
    rng = np.random.default_rng(4)
    world = ChainWorld(rng, 6, "hand")
    angles = walk(rng, 6, 120, size=0.02)
    estimator = ChainJacobian()
    state, shares = None, []
    for t, each in enumerate(angles):
        moving = world.features(each) + 30.0 * np.sin(0.15 * t + np.arange(8) // 2) + rng.normal(0.0, 0.3, 8)
        measurement = measure(each, moving, t)
        state = estimator.initial(measurement) if state is None else state
        state, estimate = estimator.step(state, measurement)
        shares.append(estimate.chained.mean())
    assert np.mean(shares[60:]) < 0.2


def test_a_bumped_board_is_learned_anew():
    rng = np.random.default_rng(6)
    world = ChainWorld(rng, 6, "world")
    angles = walk(rng, 6, 240)
    estimator = ChainJacobian()
    state, served = None, []
    for t, each in enumerate(angles):
        if t == 100:
            world.board[:, :3] += (0.05, -0.04, 0.08)
        measurement = measure(each, world.features(each) + rng.normal(0.0, 0.3, 8), t)
        state = estimator.initial(measurement) if state is None else state
        state, estimate = estimator.step(state, measurement)
        served.append(estimate.chained.all())
    assert np.mean(served[60:100]) > 0.9
    assert np.mean(served[200:]) > 0.9
    np.testing.assert_allclose(estimate.error, world.features(angles[-1]) - 240.0, atol=1.5)


def test_rows_of_a_batch_equal_single_runs_bit_by_bit():
    rng = np.random.default_rng(9)
    worlds = [[ChainWorld(rng, 5, camera) for camera in ("hand", "world", "hand")] for _ in range(2)]
    paths = np.array([[walk(rng, 5, 25) for _ in row] for row in worlds])
    noise = rng.normal(0.0, 1.0, (2, 3, 25, 8))
    visible = rng.random((2, 3, 25, 4)) < 0.9
    seen = np.array(
        [
            [[w.features(q) for q in path] for w, path in zip(*pair, strict=True)]
            for pair in zip(worlds, paths, strict=True)
        ]
    )
    seen += noise
    estimator = ChainJacobian(keyframes=12)
    state = None
    for t in range(25):
        measurement = measure(paths[:, :, t], seen[:, :, t], t)._replace(visible=visible[:, :, t])
        state = estimator.initial(measurement) if state is None else state
        state, estimate = estimator.step(state, measurement)
    for i in range(2):
        for j in range(3):
            alone = None
            for t in range(25):
                measurement = measure(paths[i, j, t], seen[i, j, t], t)._replace(visible=visible[i, j, t])
                alone = estimator.initial(measurement) if alone is None else alone
                alone, single = estimator.step(alone, measurement)
            for name in ("error", "jacobian", "covariance", "error_variance", "parameters", "nis", "log_likelihood"):
                assert np.array_equal(getattr(estimate, name)[i, j], getattr(single, name)), name
            for name, values in alone.chain._asdict().items():
                assert np.array_equal(getattr(state.chain, name)[i, j], values), name


def test_frames_at_rest_count_less_for_the_next_fit():
    """A known posture counts a quarter of a frame, and the frames between two fits are still averaged."""
    rng = np.random.default_rng(2)
    world = ChainWorld(rng, 5, "hand")
    moving = walk(rng, 5, 60, size=0.2)
    estimator, state, counts, errors = ChainJacobian(eager=60.0), None, [], []
    for t, each in enumerate(np.concatenate([moving, np.tile(moving[-1], (80, 1))])):
        measurement = measure(each, world.features(each) + rng.normal(0.0, 1.0, 8), t)
        state = estimator.initial(measurement) if state is None else state
        state, estimate = estimator.step(state, measurement)
        counts.append(state.chain.clock.copy())
        errors.append(np.abs(estimate.error - (world.features(each) - 240.0)).mean())
    frames, turns = np.array(counts).T
    np.testing.assert_array_equal(np.diff(frames[20:60]), 1.0)
    np.testing.assert_array_equal(np.diff(frames[70:]), 0.25)
    assert turns[-1] - turns[70] in (4.0, 5.0)
    assert errors[-1] < 0.4 and np.mean(errors[-10:]) < np.mean(errors[62:72])


def test_forget_keeps_the_mean():
    rng = np.random.default_rng(1)
    world = ChainWorld(rng, 5, "hand")
    angles = walk(rng, 5, 60)
    estimator = ChainJacobian()
    state, estimates = drive(estimator, world, angles, rng, noise=0.5)
    forgotten = estimator.forget(pickle.loads(pickle.dumps(state)))
    assert not forgotten.chain.weights.any()
    assert np.array_equal(forgotten.chain.parameters, state.chain.parameters)
    _, after = estimator.step(forgotten, measure(angles[-1], world.features(angles[-1]), 60))
    assert (np.einsum("mii->m", after.covariance) > np.einsum("mii->m", estimates[-1].covariance)).all()


def test_exact_laws_and_banks_accept_it():
    rng = np.random.default_rng(7)
    world = ChainWorld(rng, 6, "hand")
    angles = walk(rng, 6, 60)
    _, estimates = drive(ChainJacobian(), world, angles)
    assert isinstance(estimates[-1], ServoEstimate)
    law = OneStepExact(gain=0.3)
    _, rates = law.rate(law.initial(measure(angles[0], world.features(angles[0]), 0)), estimates[-1])
    np.testing.assert_allclose(
        estimates[-1].predict_error(PERIOD * rates, PERIOD),
        0.7 * estimates[-1].error,
        atol=0.1 * np.abs(estimates[-1].error).max(),
    )
    bank = HypothesisBank(ChainJacobian(keyframes=16), Latencies((0.0, 0.05)))
    drive(bank, world, angles[:5])


@pytest.mark.parametrize("camera", ["hand", "world"])
def test_motion_to_goal_finds_a_goal_half_a_turn_away(camera):
    rng = np.random.default_rng(11)
    world = ChainWorld(rng, 6, camera)
    # The joint next to the camera, or to the board, turns about the optical axis through the board.
    last = 5
    world.screws[last] = (0.0, 0.0, 1.0, 0.02, -0.01, 0.0)
    angles = walk(rng, 6, 90, size=0.03)
    state, estimates = drive(ChainJacobian(least_noise=1e-3), world, angles)
    wanted = angles[-1] + 0.1 * rng.uniform(-1.0, 1.0, 6)
    wanted[last] += 2.8
    goal = world.features(wanted)
    measurement = measure(angles[-1], world.features(angles[-1]), 90, goal=goal)
    _, estimate = ChainJacobian(least_noise=1e-3).step(state, measurement)
    motion, left = estimate.motion_to_goal()
    assert left < 0.5
    np.testing.assert_allclose(world.features(angles[-1] + motion), goal, atol=2.0)
    # The other way round, where a limit forbids the shorter one.
    motion, left = estimate.motion_to_goal(high=np.array([0.5, 0.5, 0.5, 0.5, 0.5, 2.0]), low=np.full(6, -4.0))
    assert left < 0.5 and motion[last] < -2.5
    np.testing.assert_allclose(world.features(angles[-1] + motion), goal, atol=2.0)
    _, left = estimates[0].motion_to_goal()
    assert left == np.inf


def test_a_center_of_none_is_the_middle_of_the_goal():
    goal = np.array([100.0, 50.0, 300.0, 90.0])
    state = ChainJacobian(center=None).initial(measure(np.zeros(3), np.zeros(4), 0, goal=goal))
    assert state.center.tolist() == [200.0, 70.0]


def test_an_image_of_twice_as_many_pixels_gives_twice_the_features():
    """What is assumed of features in px follows the image's size: to the bit for a power of two."""
    rng = np.random.default_rng(11)
    world, angles = ChainWorld(rng, 3, "hand"), walk(rng, 3, 60)
    linear = AdaptiveKalmanJacobian(feature_range=2000.0, feature_noise=1.0)
    small, large = ChainJacobian(), ChainJacobian(linear=linear)
    first, second = None, None
    for step, joints in enumerate(angles):
        features, goal = world.features(joints), np.array([240.0, 200.0, 300.0, 260.0] * 2)
        one, two = measure(joints, features, step, goal=goal), measure(joints, 2.0 * features, step, goal=2.0 * goal)
        first = small.initial(one) if first is None else first
        second = large.initial(two) if second is None else second
        first, estimate = small.step(first, one)
        second, doubled = large.step(second, two)
    assert estimate.chained.all()
    np.testing.assert_array_equal(doubled.error, 2.0 * estimate.error)
    np.testing.assert_array_equal(doubled.jacobian, 2.0 * estimate.jacobian)
    np.testing.assert_array_equal(doubled.covariance, 4.0 * estimate.covariance)
    np.testing.assert_array_equal(doubled.error_variance, 4.0 * estimate.error_variance)


def test_the_expected_focal_length_is_read_from_the_first_measurement():
    """The sum of the center's coordinates, or what goal and features span where the image's center is the origin."""
    goal = np.array([100.0, 60.0, 300.0, 80.0])
    first = measure(np.zeros(3), goal, 0, goal=goal)
    assert 600.0 * ChainJacobian().initial(first).scale == pytest.approx(270.0)
    assert 600.0 * ChainJacobian(center=(320.0, 240.0)).initial(first).scale == pytest.approx(560.0)
    assert 600.0 * ChainJacobian(focal=900.0).initial(first).scale == pytest.approx(900.0)
    centered = measure(np.zeros(3), np.array([-300.0, -300.0, 100.0, 0.0]), 0, goal=np.array([-100.0, 0.0, 100.0, 0.0]))
    assert 600.0 * ChainJacobian().initial(centered).scale == pytest.approx(500.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("focal", 0.0),
        ("keyframes", 1),
        ("iterations", 0),
        ("memory", 0.5),
        ("center", (1.0, np.nan)),
        ("focal", -1.0),
        ("rigidity", -1.0),
        ("resting", 0.0),
        ("resting", 1.5),
        ("noise", np.inf),
    ],
)
def test_bad_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must"):
        ChainJacobian(**{name: value})


def test_bad_shapes_are_refused():
    with pytest.raises(ValueError, match="features must hold two coordinates of each point, got 3"):
        ChainJacobian().initial(measure(np.zeros(2), np.zeros(3), 0))
    with pytest.raises(ValueError, match="revolute must have one entry per joint, got 3 for 2 joints"):
        ChainJacobian(revolute=(True, True, False)).initial(measure(np.zeros(2), np.zeros(4), 0))


def test_a_sliding_joint_is_learned():
    rng = np.random.default_rng(12)
    world = ChainWorld(rng, 5, "hand")
    world.screws[2] = (0.0, 0.0, 0.0, *rng.normal(0.0, 0.5, 3))
    angles = walk(rng, 5, 100)
    revolute = (True, True, False, True, True)
    estimator = replace(ChainJacobian(least_noise=1e-4), revolute=revolute)
    _, estimates = drive(estimator, world, angles)
    assert estimates[-1].chained.all()
    np.testing.assert_allclose(estimates[-1].error, world.features(angles[-1]) - 240.0, atol=1e-3)


def test_check_estimator_passes():
    check_estimator(ChainJacobian(keyframes=8), UnseenInputs(joints=3, features=4, batch=(2,)))
