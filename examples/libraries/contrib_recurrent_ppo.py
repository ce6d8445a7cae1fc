"""sb3-contrib's recurrent PPO on 16 arms with late frames and hidden latency."""

import gymnasium as gym
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.evaluation import evaluate_policy

from servotrack.baselines.training.sb3 import StableBaselinesVecEnv
from servotrack.envs import FlatSets, VectorFlatSets

SAME_STEP = gym.vector.AutoresetMode.SAME_STEP
arms = gym.make_vec("UncalibServo-v0", num_envs=16, level=6, autoreset_mode=SAME_STEP)
env = StableBaselinesVecEnv(VectorFlatSets(arms))
model = RecurrentPPO("MultiInputLstmPolicy", env, n_steps=128, batch_size=512, n_epochs=4, seed=0).learn(20_000)
mean, _ = evaluate_policy(model, FlatSets(gym.make("UncalibServo-v0", level=6)), n_eval_episodes=5)
print(f"level 6: return {mean:.1f}")
