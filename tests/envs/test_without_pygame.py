"""Checkers of Gymnasium and Stable-Baselines3 where pygame is not installed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from servotrack.envs.registration import ENVIRONMENTS

WITHOUT_PYGAME = """
import importlib.util, sys, warnings
sys.modules["pygame"] = None
import gymnasium as gym
from gymnasium.utils.env_checker import check_env
import servotrack

env_id = sys.argv[1]
warnings.simplefilter("error")
arguments = {"normalized_actions": True} if env_id == "ColorTracking-v0" else {}
env = gym.make(env_id, horizon=4, **arguments)
assert env.metadata["render_modes"] == ["rgb_array"], env.metadata
check_env(env.unwrapped)
if importlib.util.find_spec("stable_baselines3"):
    from stable_baselines3.common.env_checker import check_env as check_env_again

    check_env_again(gym.make(env_id, horizon=4, render_mode="rgb_array").unwrapped, warn=False, skip_render_check=False)
"""


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_checkers_pass_without_pygame(env_id: str) -> None:
    run = subprocess.run([sys.executable, "-c", WITHOUT_PYGAME, env_id], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr


def test_human_is_listed_where_pygame_is_installed() -> None:
    pytest.importorskip("pygame")
    import gymnasium as gym

    for env_id in ENVIRONMENTS:
        assert gym.make(env_id).metadata["render_modes"] == ["rgb_array", "human"]
