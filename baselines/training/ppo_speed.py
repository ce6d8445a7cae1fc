"""Measure how fast PPO trains with either kind of Stable-Baselines3 vector environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger

from servotrack.baselines.training.sb3 import StableBaselinesVecEnv
from servotrack.baselines.training.settings import load_settings


def ppo_speed(env_id: str, recipe: str, adapter: bool) -> Callable[[float], float]:
    """Return a function that trains for a duration, s, and returns environment steps per second.

    Args:
        env_id: Gymnasium id.
        recipe: Hyper-parameters: an entry of the package's file for the id, with its number of environments.
        adapter: True steps the native vector environment through `StableBaselinesVecEnv`; False uses
            Stable-Baselines3's `DummyVecEnv`.
    """
    torch.set_num_threads(1)
    settings = load_settings(env_id, recipe)
    num_envs, sizes = (
        settings.n_envs,
        {name: settings.hyper_parameters[name] for name in ("n_steps", "batch_size", "n_epochs")},
    )
    if adapter:
        mode = gym.vector.AutoresetMode.SAME_STEP
        env: Any = StableBaselinesVecEnv(gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=mode), info_keys=())
    else:
        env = make_vec_env(env_id, num_envs)
    model = PPO("MultiInputPolicy", env, **sizes, seed=0, device="cpu")
    model.set_logger(Logger(None, []))  # Its own makes a folder among the temporary files for each call of learn.

    def run(duration: float) -> float:
        steps, start = model.num_timesteps, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            model.learn(sizes["n_steps"] * num_envs, reset_num_timesteps=False)
        return (model.num_timesteps - steps) / elapsed

    return run
