"""`spec.max_episode_steps` of every id: the steps after which an episode with these arguments is truncated."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.estimators.testing.bits import first_difference

IDS = sorted(ENVIRONMENTS)
DEFAULT_STEPS = {
    "UncalibServo-v0": 252, "UncalibServoReach-v0": 100, "UncalibServoPixels-v0": 252, "UncalibServo3D-v0": 800,
    "PedestrianServo-v0": 400, "ClutterTracking-v0": 100, "PedestrianTracking-v0": 300, "ColorTracking-v0": 200,
    "SonarTracking-v0": 65, "VideoTracking-v0": 60, "RecordedPoints-v0": 60,
}  # fmt: skip


def wrappers(env: Any) -> list[str]:
    """Names of the wrappers around an environment, the outermost first."""
    names = []
    while env is not env.unwrapped:
        names.append(type(env).__name__)
        env = env.env
    return names


def play(env: gym.Env[Any, Any], steps: int) -> list[Any]:
    """Results of at most `steps` steps, ending with the episode."""
    env.action_space.seed(0)
    results: list[Any] = [env.reset(seed=1)]
    while len(results) <= steps:
        results.append(env.step(env.action_space.sample()))
        if results[-1][2] or results[-1][3]:
            break
    return results


@pytest.mark.parametrize("env_id", IDS)
def test_the_limit_of_the_default_arguments(env_id: str) -> None:
    env = gym.make(env_id)
    assert env.spec is not None and env.spec.max_episode_steps == DEFAULT_STEPS[env_id]
    assert "TimeLimit" not in wrappers(env)
    vector = gym.make_vec(env_id, num_envs=2)
    assert vector.spec is not None and vector.spec.max_episode_steps == DEFAULT_STEPS[env_id]
    assert gym.spec(env_id).max_episode_steps is None, "the registered specification must not change"


@pytest.mark.parametrize("env_id", IDS)
def test_an_episode_is_truncated_after_that_many_steps(env_id: str) -> None:
    env = gym.make(env_id, horizon=7)
    assert env.spec is not None and env.spec.max_episode_steps is not None
    results = play(env, 100)
    assert len(results) - 1 == env.spec.max_episode_steps and results[-1][3]


@pytest.mark.parametrize(
    "env_id", [env_id for env_id in IDS if env_id not in ("VideoTracking-v0", "RecordedPoints-v0")]
)
def test_a_longer_horizon_is_not_cut(env_id: str) -> None:
    longer = DEFAULT_STEPS[env_id] + 5
    env = gym.make(env_id, horizon=longer)
    assert env.spec is not None and (env.spec.max_episode_steps or 0) >= longer
    vector = gym.make_vec(env_id, num_envs=1, horizon=longer)
    assert vector.spec is not None and vector.spec.max_episode_steps == env.spec.max_episode_steps


def test_a_longer_episode_is_played_to_its_end() -> None:
    env = gym.make("ClutterTracking-v0", horizon=120)
    results = play(env, 1000)
    assert len(results) - 1 == 120


@pytest.mark.parametrize("level", range(7))
def test_every_level_has_its_own_limit(level: int) -> None:
    env = gym.make("UncalibServo-v0", level=level)
    config = env.unwrapped.config  # type: ignore[attr-defined]
    assert env.spec is not None and env.spec.max_episode_steps == config.warmup + config.horizon
    assert (config.warmup == 8) == (level < 2)


@pytest.mark.parametrize("env_id", IDS)
def test_an_environment_made_from_the_specification_plays_the_same_episode(env_id: str) -> None:
    """`gym.make(env.spec)` adds a `TimeLimit` of the same length."""
    env = gym.make(env_id, horizon=6)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert again.spec == env.spec and "TimeLimit" in wrappers(again)
    assert first_difference(play(env, 50), play(again, 50), "episode") is None


@pytest.mark.parametrize("env_id", IDS)
def test_a_vector_environment_made_from_the_specification_plays_the_same_episode(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=2, horizon=4, autoreset_mode=AutoresetMode.SAME_STEP)
    assert env.spec is not None
    again = gym.make_vec(env.spec)
    env.action_space.seed(0)
    assert first_difference(env.reset(seed=2), again.reset(seed=2), "reset") is None
    for _ in range(8):
        actions = env.action_space.sample()
        assert first_difference(env.step(actions), again.step(actions), "step") is None


def test_a_limit_of_gymnasium_is_the_smaller_one() -> None:
    env = gym.make("UncalibServo-v0", max_episode_steps=3)
    assert env.spec is not None and env.spec.max_episode_steps == 3
    vector = gym.make_vec("UncalibServo-v0", num_envs=1, max_episode_steps=3)
    assert vector.spec is not None and vector.spec.max_episode_steps == 3
    vector.reset(seed=0)
    assert [bool(vector.step(np.zeros((1, 2), np.float32))[3][0]) for _ in range(3)] == [False, False, True]
    unlimited = gym.make_vec("UncalibServo-v0", num_envs=1, max_episode_steps=1000)
    assert unlimited.spec is not None and unlimited.spec.max_episode_steps == 252
