"""RLlib: PPO with two workers."""

import gymnasium as gym
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune import register_env

from servotrack.envs import FlatSets


def make(config):
    """Return an environment whose observation is one vector."""
    return gym.wrappers.FlattenObservation(FlatSets(gym.make("UncalibServo-v0", level=2)))


register_env("servo", make)
config = PPOConfig().environment("servo").env_runners(num_env_runners=1, num_envs_per_env_runner=8)
algorithm = config.training(train_batch_size_per_learner=4_000, num_epochs=5).build_algo()
for _ in range(3):
    result = algorithm.train()
print(f"level 2: return {result['env_runners']['episode_return_mean']:.1f}")
