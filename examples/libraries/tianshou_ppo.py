"""tianshou's experiment builder: PPO on 16 arms."""

import gymnasium as gym
from tianshou.highlevel.config import OnPolicyTrainingConfig
from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
from tianshou.highlevel.experiment import ExperimentConfig, PPOExperimentBuilder
from tianshou.highlevel.params.algorithm_params import PPOParams

from servotrack.envs import FlatSets

gym.register(
    "FlatServo-v0", lambda **options: gym.wrappers.FlattenObservation(FlatSets(gym.make("UncalibServo-v0", **options)))
)
arms = EnvFactoryRegistered(task="FlatServo-v0", venv_type=VectorEnvType.DUMMY, level=2)
times = {"max_epochs": 3, "epoch_num_steps": 10_000, "collection_step_num_env_steps": 4_096}
sizes = {"num_training_envs": 16, "num_test_envs": 5, "test_step_num_episodes": 5, "batch_size": 512}
training = OnPolicyTrainingConfig(**times, **sizes, update_step_num_repetitions=8)
builder = PPOExperimentBuilder(arms, ExperimentConfig(persistence_enabled=False, watch=False), training)
result = builder.with_ppo_params(PPOParams(gamma=0.95, lr=1e-3)).build().run()
print(f"level 2: return {result.trainer_result.best_reward:.1f}")
