"""Wrappers that add the ground truth, and oracles that use it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation
from servotrack.estimators.camera import project_points


@pytest.mark.parametrize("level", [0, 3, 6])
def test_the_observation_is_wider_and_in_its_space(level: int) -> None:
    env = PrivilegedObservation(gym.make("UncalibServo-v0", level=level))
    bare = gym.make("UncalibServo-v0", level=level)
    observation, plain = env.reset(seed=3)[0], bare.reset(seed=3)[0]
    for _ in range(5):
        assert observation in env.observation_space
        for key, value in plain.items():
            np.testing.assert_array_equal(observation[key], value)
        observation, plain = env.step(np.ones(2, np.float32))[0], bare.step(np.ones(2, np.float32))[0]
    assert {key for key in observation if key not in plain} == {key for key in observation if key.startswith("true_")}


def test_the_vector_wrapper_gives_what_single_ones_give() -> None:
    wide = VectorPrivilegedObservation(gym.make_vec("UncalibServo-v0", num_envs=3, level=5))
    singles = [PrivilegedObservation(gym.make("UncalibServo-v0", level=5)) for _ in range(3)]
    together = wide.reset(seed=10)[0]
    apart = [env.reset(seed=10 + row)[0] for row, env in enumerate(singles)]
    for _ in range(4):
        assert together in wide.observation_space
        for row, own in enumerate(apart):
            for key, value in own.items():
                np.testing.assert_array_equal(together[key][row], value, err_msg=key)
        together = wide.step(np.full((3, 2), 0.3, np.float32))[0]
        apart = [env.step(np.full(2, 0.3, np.float32))[0] for env in singles]


@pytest.mark.parametrize("level", [0, 3])
def test_the_true_jacobian_is_that_of_differences(level: int) -> None:
    env = PrivilegedObservation(gym.make("UncalibServo-v0", level=level, warmup=0))
    env.reset(seed=5)
    step = 1e-6
    for _ in range(10):
        observation, *_, info = env.step(np.array([0.4, -0.3], np.float32))
        truth = info["truth"]
        for column, offset in enumerate(np.eye(3) * step):
            ends = []
            for sign in (1, -1):
                joints = truth["joint_angles"] + sign * offset[:2]
                point = truth["target"] + sign * offset[2] * truth["target_velocity"]
                ends.append(project_points(observation["true_camera"], observation["true_links"], joints, point)[0])
            differences = (ends[0] - ends[1]) / (2 * step)
            np.testing.assert_allclose(observation["true_jacobian"][:, column], differences, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_an_oracle_solves_nearly_every_layout(level: int) -> None:
    """Steer with the true Jacobian on noisy features: without estimation errors the task must be solvable."""
    count, gain, period = 64, 4.0, 0.05
    env = VectorPrivilegedObservation(gym.make_vec("UncalibServo-v0", num_envs=count, level=level))
    observation, _ = env.reset(seed=list(range(100_000, 100_000 + count)))
    errors, lost = [], np.zeros(count, bool)
    steps = env.unwrapped.config.warmup + env.unwrapped.config.horizon
    for _ in range(steps - 1):
        jacobian = observation["true_jacobian"]
        wanted = -gain * (observation["features"] - observation["goal"]) - jacobian[:, :, 2]
        rates = np.linalg.solve(jacobian[:, :, :2], wanted[:, :, None])[:, :, 0] / env.unwrapped.max_joint_rate
        rates /= np.maximum(np.abs(rates).max(axis=1, keepdims=True), 1.0)
        observation, _, terminated, _, info = env.step(rates.astype(np.float32))
        lost |= terminated
        errors.append(info["tracking_error"])
    steady = np.array(errors)[round(3.0 / period) :].mean(axis=0)
    assert ((steady < 0.010) & ~lost).mean() >= 0.9


def test_worlds_without_truth_are_named() -> None:
    with pytest.raises(TypeError, match=r"has no method `privileged\(\)`"):
        PrivilegedObservation(gym.make("CartPole-v1"))


def test_observations_without_keys_get_one() -> None:
    class Flat(gym.Env[Any, Any]):
        observation_space, action_space = gym.spaces.Box(0, 1, (2,)), gym.spaces.Discrete(2)

        def privileged(self) -> dict[str, Any]:
            return {"true_state": np.zeros(2)}

    env = PrivilegedObservation(Flat())
    assert set(env.observation_space.spaces) == {"observation", "true_state"}
    assert env.observation(np.ones(2))["observation"].tolist() == [1.0, 1.0]
