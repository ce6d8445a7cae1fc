"""Stable-Baselines3's SAC on one arm."""

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

import servotrack  # noqa: F401
from servotrack.envs import FlatSets

env = FlatSets(gym.make("UncalibServo-v0", level=2))
model = SAC("MultiInputPolicy", env, learning_starts=1_000, seed=0).learn(3_000)
mean, _ = evaluate_policy(model, env, n_eval_episodes=10)
print(f"level 2: return {mean:.1f}")
