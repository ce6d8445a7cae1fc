"""Calibrated servos of serial arms reach the goal; scores of their episodes by hand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo3d.model_free import create_model_free_servo
from servotrack.baselines.evaluation.bench import default_agents, suite_of
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.servo3d_scores import LOST_ERROR, servo3d_errors
from servotrack.envs.wrappers import PrivilegedObservation

ENV_ID = "UncalibServo3D-v0"
AGENTS = ["ibvs", "ibvs-desired", "ibvs-mean", "pbvs", "joint-oracle"]
MODEL_FREE = ["any-arm", "chain", "adaptive-kf", "latency-bank-adaptive-kf", "expert-kf"]
ARMS = [("so101", "hand"), ("panda", "world"), ("ur5e", "world")]


@pytest.mark.parametrize("agent", AGENTS)
def test_calibrated_servos_settle_on_the_goal(agent):
    for arm, camera in ARMS:
        arguments = {"level": 0, "arm": arm, "camera": camera}
        rows = evaluate(ENV_ID, agent, range(100_000, 100_002), env_kwargs=arguments, timing=False).rows
        assert all(row["success"] for row in rows), (arm, camera)
        assert max(row["settle"] for row in rows) < 20.0
        assert max(row["tip"] for row in rows) < 1e-3


def test_a_single_point_is_centered_by_its_image_and_refused_by_its_pose():
    arguments = {"level": 1, "arm": "panda", "points": 1}
    rows = evaluate(ENV_ID, "ibvs", range(100_000, 100_003), env_kwargs=arguments, timing=False).rows
    assert max(row["feature_error"] for row in rows) < 2.0
    env = PrivilegedObservation(gym.make(ENV_ID, **arguments))
    with pytest.raises(ValueError, match=r"pose.* needs at least 4 points .* got points=1"):
        create_agent("pbvs", env)


def test_observations_without_the_truth_are_refused():
    with pytest.raises(ValueError, match="UncalibServo3D-v0 lacks them: wrap UncalibServo3D-v0 in Privileged"):
        create_agent("ibvs", gym.make(ENV_ID))


def test_single_and_batched_answers_agree():
    single = PrivilegedObservation(gym.make(ENV_ID, level=4))
    observation, _ = single.reset(seed=1)
    batch = {key: np.stack([value, value]) for key, value in observation.items()}
    for name in AGENTS:
        agent = create_agent(name, single)
        alone, _ = agent.predict(observation)
        together, _ = agent.predict(batch, None, np.ones(2, bool))
        np.testing.assert_allclose(together, np.stack([alone, alone]), atol=1e-6)
        assert alone.dtype == np.float32
        assert np.abs(alone).max() <= 1.0


def test_the_suite_offers_the_random_the_calibrated_and_the_model_free_agents():
    assert sorted(default_agents(ENV_ID)) == sorted(["random", *AGENTS, *MODEL_FREE])
    assert {cell.agent for cell in suite_of(ENV_ID, levels=[1])} == {"random", *AGENTS, *MODEL_FREE}


@pytest.mark.parametrize(("arm", "camera"), [("so101", "hand"), ("panda", "world")])
def test_an_arm_of_which_nothing_is_known_reaches_its_goal(arm, camera):
    """With homing errors, coarse encoders, motors that lag, backlash, and encoders of another age than the frames."""
    arguments = {"level": 3, "arm": arm, "camera": camera}
    rows = evaluate(ENV_ID, "any-arm", range(100_020, 100_024), env_kwargs=arguments, timing=False).rows
    assert sum(row["success"] for row in rows) >= 3


@pytest.mark.slow
def test_an_arm_of_seven_joints_with_a_camera_of_many_pixels_reaches_its_goal():
    """Play of a degree shows as 20 pixels: it neither counts as a board that moves nor as a lasting error."""
    up, side = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]
    arm = {
        "name": "seven",
        "axes": [up, side, up, [0.0, -1.0, 0.0], up, side, up],
        "points": [[0.0, 0.0, height] for height in (0.3, 0.5, 0.83, 1.0, 1.3, 1.4, 1.4)],
        "tool": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.56], [0.0, 0.0, 0.0, 1.0]],
        "low": [-2.9] * 7,
        "high": [2.9] * 7,
        "masses": [5.0, 4.0, 3.0, 3.0, 2.0, 1.5, 0.3],
        "ready": [0.0, 0.6, 0.0, -1.3, 0.0, 1.1, 0.0],
    }
    arguments = {"level": 3, "arm": arm, "width": 1280, "height": 960, "focal": (900.0, 1600.0)}
    rows = evaluate(ENV_ID, "any-arm", range(100_200, 100_208), env_kwargs=arguments, timing=False).rows
    assert sum(row["success"] for row in rows) >= 7


@pytest.mark.parametrize("agent", ["adaptive-kf", "chain"])
def test_the_other_servos_reach_it_with_less_in_their_way(agent):
    rows = evaluate(ENV_ID, agent, range(100_020, 100_024), env_kwargs={"level": 1, "horizon": 400}, timing=False).rows
    assert sum(row["feature_error"] < 5.0 for row in rows) >= 3


def test_late_encoders_without_stamps_need_the_bank():
    arguments = {"level": 1, "encoder_age": (0, 2), "stamped": False}
    arrived = {}
    for agent in ("latency-bank-adaptive-kf", "adaptive-kf"):
        rows = evaluate(ENV_ID, agent, range(100_000, 100_006), arguments, timing=False).rows
        arrived[agent] = sum(row["feature_error"] < 5.0 for row in rows)
    assert arrived["latency-bank-adaptive-kf"] >= 5 > arrived["adaptive-kf"]


def test_model_free_agents_refuse_other_worlds():
    with pytest.raises(ValueError, match=r"adaptive-kf.* UncalibServo-v0 lacks them: choose UncalibServo3D-v0"):
        create_model_free_servo(gym.make("UncalibServo-v0"), "adaptive-kf")


def test_a_model_free_agent_acts_alone_as_in_a_batch():
    env = gym.make(ENV_ID, level=3)
    observation, _ = env.reset(seed=100_000)
    batch = {key: np.stack([value, value]) for key, value in observation.items()}
    for name in MODEL_FREE:
        agent = create_agent(name, env)
        alone, together = None, None
        for _ in range(12):
            action, alone = agent.predict(observation, alone)
            both, together = agent.predict(batch, together)
            np.testing.assert_array_equal(both, np.stack([action, action]))
            observation, *_ = env.step(action)
            batch = {key: np.stack([value, value]) for key, value in observation.items()}


def test_scores_of_a_servo_that_settles_after_half_the_time():
    time, n = 0.5 * np.arange(1, 41), 40
    tip = np.where(time < 9.9, 0.02, 1e-3)
    row = servo3d_errors(time, tip, np.zeros(n), tip / 2e-3, 0.0, n)
    # The first sample inside is the one at 10 s; the second half decides on success.
    assert row["settle"] == pytest.approx(10.0)
    assert row["success"]
    assert row["tip"] == pytest.approx(1e-3)
    assert row["hold"] == pytest.approx((9 * 10.0 + 21 * 0.5) / 30)


def test_leaving_the_bounds_at_the_end_is_not_settled_and_one_wrong_angle_is_no_success():
    time, n = 0.5 * np.arange(1, 41), 40
    tip = np.where(time > 19.9, 0.01, 0.0)
    assert servo3d_errors(time, tip, np.zeros(n), tip, 0.0, n)["settle"] == pytest.approx(20.0)
    assert servo3d_errors(time, np.zeros(n), np.zeros(n), np.zeros(n), 0.0, n)["settle"] == pytest.approx(0.5)
    assert not servo3d_errors(time, np.zeros(n), np.full(n, 0.02), tip, 0.0, n)["success"]


def test_an_episode_that_ends_early_counts_as_lost_for_the_rest():
    time = 0.5 * np.arange(1, 11)
    row = servo3d_errors(time, np.zeros(10), np.zeros(10), np.zeros(10), 0.0, 40)
    assert row["hold"] == LOST_ERROR
    assert row["settle"] == pytest.approx(20.0)
    assert not row["success"]
