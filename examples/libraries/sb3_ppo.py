"""Stable-Baselines3's PPO on 16 arms side by side."""

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

from servotrack.baselines.training.sb3 import StableBaselinesVecEnv
from servotrack.envs import FlatSets, VectorFlatSets

SAME_STEP = gym.vector.AutoresetMode.SAME_STEP
arms = gym.make_vec("UncalibServo-v0", num_envs=16, level=2, autoreset_mode=SAME_STEP)
model = PPO("MultiInputPolicy", StableBaselinesVecEnv(VectorFlatSets(arms)), n_steps=256, batch_size=512, seed=0)
model.learn(150_000)
mean, _ = evaluate_policy(model, FlatSets(gym.make("UncalibServo-v0", level=2)), n_eval_episodes=10)
print(f"level 2: return {mean:.1f}")
