"""Infos of every id: the same entries at reset and at step, in the layout of Gymnasium's vector environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.estimators.testing.bits import first_difference

IDS = sorted(ENVIRONMENTS)
SERVOS = ("UncalibServo-v0", "UncalibServoReach-v0", "UncalibServoPixels-v0", "UncalibServo3D-v0", "PedestrianServo-v0")
STEPS = 4


def make_arguments(env_id: str) -> dict[str, Any]:
    """Arguments that end an episode after `STEPS` steps."""
    own = {"lag": 1, "horizon": STEPS - 1} if env_id == "SonarTracking-v0" else {"horizon": STEPS}
    return own | ({"warmup": 0} if env_id in SERVOS and env_id != "UncalibServo3D-v0" else {})


def form(value: Any) -> Any:
    """Type, data type and shape of everything in an info."""
    if isinstance(value, dict):
        return {key: form(item) for key, item in value.items()}
    return type(value).__name__ + (f"{value.dtype}{value.shape}" if isinstance(value, np.ndarray) else "")


@pytest.mark.parametrize("env_id", IDS)
def test_every_info_of_an_episode_has_the_same_entries(env_id: str) -> None:
    env = gym.make(env_id, **make_arguments(env_id))
    env.action_space.seed(0)
    for seed in (1, 2):
        _, info = env.reset(seed=seed)
        first, truncated, steps = form(info), False, 0
        while not truncated:
            _, _, _, truncated, info = env.step(env.action_space.sample())
            assert form(info) == first
            steps += 1
        assert steps == STEPS


@pytest.mark.parametrize("env_id", SERVOS)
def test_success_is_also_reported_under_the_name_that_stable_baselines_logs(env_id: str) -> None:
    env = gym.make(env_id, **make_arguments(env_id))
    assert env.reset(seed=0)[1]["is_success"] is False
    vector = gym.make_vec(env_id, num_envs=2, **make_arguments(env_id))
    _, infos = vector.reset(seed=0)
    assert infos["is_success"].dtype == np.bool_ and infos["_is_success"].all()
    for _ in range(STEPS - 1):
        _, _, _, _, info = env.step(np.zeros(env.action_space.shape, np.float32))  # type: ignore[arg-type]
        assert info["is_success"] is info["success"]


def test_success_is_reported_as_such_when_it_happens() -> None:
    env = gym.make("UncalibServo-v0", level=0, warmup=0)
    env.reset(seed=0)
    env.unwrapped.world.tracking_error[:] = 0.005  # type: ignore[attr-defined]
    info = env.unwrapped._info()  # type: ignore[attr-defined]
    assert info["success"] is info["is_success"] is True


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("env_id", IDS)
def test_vector_infos_have_the_layout_of_gymnasiums_own_vector_environments(env_id: str, mode: AutoresetMode) -> None:
    """Compared with N single environments in a `SyncVectorEnv`, over the end of an episode: entries, masks, values."""
    arguments = make_arguments(env_id)
    ours = gym.make_vec(env_id, num_envs=2, autoreset_mode=mode, **arguments)
    theirs = SyncVectorEnv([lambda: gym.make(env_id, **arguments)] * 2, autoreset_mode=mode)
    ours.action_space.seed(0)
    results = [(env.reset(seed=3)[1]) for env in (ours, theirs)]
    assert first_difference(*results, "infos of reset") is None
    for step in range(STEPS + 2):
        actions = ours.action_space.sample()
        (*_, mine), (*_, other) = ours.step(actions), theirs.step(actions)
        assert first_difference(mine, other, f"infos of step {step}") is None


@pytest.mark.parametrize("env_id", ["ColorTracking-v0", "ClutterTracking-v0"])
def test_an_episode_that_was_cut_is_not_scored_as_a_whole(env_id: str) -> None:
    vector = gym.make_vec(env_id, num_envs=2, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=2, horizon=STEPS)
    vector.reset(seed=0)
    for _ in range(2):
        _, _, _, truncated, infos = vector.step(vector.action_space.sample())
    assert truncated.all() and not infos["episode_scored"].any()
