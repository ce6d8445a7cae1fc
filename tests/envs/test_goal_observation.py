"""The goal form keeps the contract of Gymnasium-Robotics' `GoalEnv`, and hindsight replay trains with it."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs import GoalObservation

CASES: list[tuple[str, dict[str, Any]]] = [
    ("UncalibServoReach-v0", {"level": 0, "warmup": 0}),
    ("UncalibServoReach-v0", {"level": 4}),
    ("UncalibServo3D-v0", {"level": 0}),
    ("UncalibServo3D-v0", {"level": 4, "points": 5}),
]
KEYS = ("observation", "achieved_goal", "desired_goal")
REWARDS = ("sparse", "dense")


def episode(env: GoalObservation, seed: int) -> list[tuple[Any, ...]]:
    """Results of the steps of one episode with random actions."""
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    assert observation in env.observation_space
    results: list[tuple[Any, ...]] = []
    while not results or not (results[-1][2] or results[-1][3]):
        results.append(env.step(env.action_space.sample()))
    return results


@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize(("env_id", "arguments"), CASES)
def test_rewards_and_ends_are_those_of_the_goals(env_id: str, arguments: dict[str, Any], reward: str) -> None:
    env = GoalObservation(gym.make(env_id, horizon=60, **arguments), reward)
    results = [result for seed in range(2) for result in episode(env, seed)]
    for observation, value, terminated, truncated, info in results:
        assert observation in env.observation_space and set(observation) == set(KEYS)
        goals = observation["achieved_goal"], observation["desired_goal"]
        assert value == env.compute_reward(*goals, info) and isinstance(value, float)
        assert terminated is env.compute_terminated(*goals, info) is False
        assert truncated is env.compute_truncated(*goals, info)
    batch = [np.stack([observation[key] for observation, *_ in results]) for key in KEYS[1:]]
    infos = [info for *_, info in results]
    np.testing.assert_array_equal(env.compute_reward(*batch, infos), [value for _, value, *_ in results])
    np.testing.assert_array_equal(env.compute_terminated(*batch, infos), [ended for _, _, ended, *_ in results])
    np.testing.assert_array_equal(env.compute_truncated(*batch, infos), [cut for _, _, _, cut, _ in results])
    columns = {"episode_over": np.array([info["episode_over"] for info in infos])}
    np.testing.assert_array_equal(env.compute_truncated(*batch, columns), [cut for _, _, _, cut, _ in results])
    assert not env.compute_truncated(*batch, [{}] * len(infos)).any()  # type: ignore[union-attr]


@pytest.mark.parametrize(("env_id", "arguments"), CASES)
def test_goals_are_the_measured_image_points_and_the_wanted_ones(env_id: str, arguments: dict[str, Any]) -> None:
    plain, env = gym.make(env_id, **arguments), GoalObservation(gym.make(env_id, **arguments))
    raw, _ = plain.reset(seed=3)
    seen, _ = env.reset(seed=3)
    extent: Any = plain.observation_space["features"].high  # type: ignore[index]
    for name, key in (("features", "achieved_goal"), ("goal", "desired_goal")):
        np.testing.assert_allclose(seen[key] * extent[0] / 2 + extent / 2, raw[name], atol=1e-4)
    error = env.goal_error(seen["achieved_goal"], seen["desired_goal"])
    points = (raw["features"] - raw["goal"]).reshape(-1, 2)
    assert error == pytest.approx(np.linalg.norm(points, axis=1).mean(), rel=1e-5)


def test_the_sparse_reward_is_zero_within_the_threshold() -> None:
    env = GoalObservation(gym.make("UncalibServoReach-v0", level=0), threshold=2.0)
    size = env.unwrapped.config.camera_size  # type: ignore[attr-defined]
    goal = np.zeros((4, 2))
    offsets = np.array([[0.0, 0.0], [1.9, 0.0], [0.0, 2.1], [100.0, 0.0]]) / (size / 2)
    np.testing.assert_array_equal(env.compute_reward(goal + offsets, goal, {}), [0.0, 0.0, -1.0, -1.0])
    dense = GoalObservation(env.env, "dense")
    np.testing.assert_allclose(dense.compute_reward(goal + offsets, goal, {}), -np.hypot(*offsets.T))


def test_an_episode_whose_target_was_lost_is_truncated_and_never_pays() -> None:
    env = GoalObservation(gym.make("UncalibServoReach-v0", level=2, horizon=200), "dense")
    plain = gym.make("UncalibServoReach-v0", level=2, horizon=200)
    for made in (env, plain):
        made.reset(seed=0)
    for _ in range(200):
        _, reward, terminated, truncated, info = env.step(np.ones(2, np.float32))
        _, _, lost, _, _ = plain.step(np.ones(2, np.float32))
        assert reward < 0.0 and not terminated and truncated == info["episode_over"] == lost
        if lost:
            return
    raise AssertionError("the target must leave the view")


@pytest.mark.parametrize(
    ("env_id", "arguments", "error", "message"),
    [
        ("UncalibServoPixels-v0", {}, TypeError, "needs the observations features and goal"),
        ("ClutterTracking-v0", {}, TypeError, "needs the observations features and goal"),
        ("UncalibServoReach-v0", {"reward": "shaped"}, ValueError, "reward must be one of sparse, dense, got 'shaped'"),
        ("UncalibServoReach-v0", {"threshold": 0.0}, ValueError, "threshold must be a positive number of px, got 0.0"),
        ("UncalibServoReach-v0", {"threshold": float("nan")}, ValueError, "threshold must be a positive number"),
        ("UncalibServoReach-v0", {"threshold": "5"}, ValueError, "threshold must be a positive number of px, got '5'"),
    ],
)
def test_bad_arguments_are_named(env_id: str, arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        GoalObservation(gym.make(env_id), **arguments)


@pytest.mark.parametrize(("env_id", "arguments"), CASES)
def test_stable_baselines_checker_is_silent(env_id: str, arguments: dict[str, Any]) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = GoalObservation(gym.make(env_id, horizon=20, **arguments))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)
    # The checker looks for a goal environment behind all wrappers; these are its checks of one.
    env.reset(seed=0)
    observation, reward, _, _, info = env.step(env.action_space.sample())
    checker._check_goal_env_obs(observation, env.observation_space, "step")
    checker._check_goal_env_compute_reward(observation, env, float(reward), info)


@pytest.mark.parametrize("env_id", ["UncalibServoReach-v0", "UncalibServo3D-v0"])
def test_hindsight_experience_replay_trains(env_id: str) -> None:
    algorithms = pytest.importorskip("stable_baselines3")
    env = GoalObservation(gym.make(env_id, horizon=10))
    model = algorithms.SAC(
        "MultiInputPolicy", env, replay_buffer_class=algorithms.HerReplayBuffer, learning_starts=20, buffer_size=1000,
        batch_size=16, device="cpu", seed=0,
    )  # fmt: skip
    model.learn(60)
    assert model.num_timesteps == 60 and model._n_updates > 0
    relabeled = model.replay_buffer.sample(64).rewards
    assert set(np.unique(relabeled.numpy())) == {-1.0, 0.0}, "relabeled goals must reach themselves"
