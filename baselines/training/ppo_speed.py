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


def ppo_speed(env_id: str, num_envs: int, adapter: bool) -> Callable[[float], float]:
    """Return a function that trains for a duration, s, and returns environment steps per second.

    Args:
        env_id: Gymnasium id.
        num_envs: Number of environments side by side.
        adapter: True steps the native vector environment through `StableBaselinesVecEnv`; False uses
            Stable-Baselines3's `DummyVecEnv`.
    """
    torch.set_num_threads(1)
    if adapter:
        mode = gym.vector.AutoresetMode.SAME_STEP
        env: Any = StableBaselinesVecEnv(gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=mode), info_keys=())
    else:
        env = make_vec_env(env_id, num_envs)
    model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=2048, n_epochs=5, seed=0, device="cpu")
    model.set_logger(Logger(None, []))  # Its own makes a folder among the temporary files for each call of learn.

    def run(duration: float) -> float:
        steps, start = model.num_timesteps, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < duration:
            model.learn(64 * num_envs, reset_num_timesteps=False)
        return (model.num_timesteps - steps) / elapsed

    return run
