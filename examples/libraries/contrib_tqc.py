"""sb3-contrib's TQC on one arm."""

import gymnasium as gym
from sb3_contrib import TQC
from stable_baselines3.common.evaluation import evaluate_policy

import servotrack  # noqa: F401
from servotrack.envs import FlatSets

env = FlatSets(gym.make("UncalibServo-v0", level=2))
model = TQC("MultiInputPolicy", env, learning_starts=1_000, seed=0).learn(2_500)
mean, _ = evaluate_policy(model, env, n_eval_episodes=10)
print(f"level 2: return {mean:.1f}")
