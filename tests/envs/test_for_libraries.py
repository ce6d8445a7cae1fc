"""Spaces that reinforcement learning libraries accept: both checkers are silent for every id, and policies train."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import servotrack  # noqa: F401
from servotrack.envs import FlatSets, VectorFlatSets
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.estimators.testing.bits import first_difference

IDS = sorted(ENVIRONMENTS)
SMALL_IMAGES: list[tuple[str, dict[str, Any]]] = [
    ("UncalibServoPixels-v0", {"image_size": 32}),
    ("PedestrianServo-v0", {"observation": "pixels", "image_size": 32}),
    ("PedestrianServo-v0", {"observation": "identity"}),
]
CASES = [(env_id, {}) for env_id in IDS] + SMALL_IMAGES


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasiums_checker_is_silent(env_id: str) -> None:
    arguments = {"normalized_actions": True} if env_id == "ColorTracking-v0" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, horizon=4, **arguments).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("env_id", "arguments"), CASES)
def test_stable_baselines_checker_is_silent(env_id: str, arguments: dict[str, Any]) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(FlatSets(gym.make(env_id, horizon=4, **arguments)))


@pytest.mark.parametrize(("env_id", "arguments"), CASES)
def test_policies_train(env_id: str, arguments: dict[str, Any]) -> None:
    algorithms = pytest.importorskip("stable_baselines3")
    env = FlatSets(gym.make(env_id, horizon=4, **arguments))
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    if not isinstance(env.observation_space, gym.spaces.Dict) and len(env.observation_space.shape or ()) == 3:
        policy = "CnnPolicy"
    model = algorithms.PPO(policy, env, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    assert model.learn(16).num_timesteps == 16
    assert np.isfinite(model.predict(env.reset(seed=0)[0])[0]).all()


@pytest.mark.parametrize("env_id", ["PedestrianServo-v0", "UncalibServo3D-v0", "SonarTracking-v0"])
def test_a_vector_environment_gives_what_single_ones_give(env_id: str) -> None:
    arguments = {"horizon": 2}
    ours = VectorFlatSets(gym.make_vec(env_id, 2, autoreset_mode=AutoresetMode.SAME_STEP, **arguments))
    theirs = SyncVectorEnv(
        [lambda: FlatSets(gym.make(env_id, **arguments))] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    ours.action_space.seed(0)
    assert first_difference(ours.reset(seed=1), theirs.reset(seed=1), "reset") is None
    for _ in range(5):
        actions = ours.action_space.sample()
        assert first_difference(ours.step(actions), theirs.step(actions), "step") is None


def test_small_images_are_enlarged_by_repeating_pixels_and_the_rest_is_scaled() -> None:
    plain = gym.make("PedestrianServo-v0")
    env = FlatSets(gym.make("PedestrianServo-v0"))
    raw, _ = plain.reset(seed=0)
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space and raw["target_patch"].shape == (32, 32, 3)
    assert seen["target_patch"].shape == (64, 64, 3) and seen["target_patch"].dtype == np.uint8
    np.testing.assert_array_equal(seen["target_patch"][::2, ::2], raw["target_patch"])
    np.testing.assert_array_equal(seen["target_patch"][1::2, 1::2], raw["target_patch"])
    box: Any = plain.observation_space["goal"]  # type: ignore[index]
    np.testing.assert_allclose(seen["goal"], 2.0 * (raw["goal"] - box.low) / (box.high - box.low) - 1.0, rtol=1e-6)
    assert seen["detections"].shape == (raw["detections"].size,)


def test_large_images_stay_as_they_are() -> None:
    env = FlatSets(gym.make("ColorTracking-v0"))
    raw, _ = gym.make("ColorTracking-v0").reset(seed=0)
    np.testing.assert_array_equal(env.reset(seed=0)[0]["frame"], raw["frame"])
