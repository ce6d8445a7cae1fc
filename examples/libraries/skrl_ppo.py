"""skrl's PPO on 64 arms side by side."""

import gymnasium as gym
import numpy as np
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

from servotrack.envs import VectorFlatSets

arms = gym.wrappers.vector.FlattenObservation(VectorFlatSets(gym.make_vec("UncalibServo-v0", num_envs=64, level=2)))
arms = gym.wrappers.vector.RecordEpisodeStatistics(arms)
env = wrap_env(arms, wrapper="gymnasium")
spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
layers = [{"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}]
policy = gaussian_model(**spaces, network=layers, output="ACTIONS")
value = deterministic_model(**spaces, network=layers, output="ONE")
memory = RandomMemory(memory_size=64, num_envs=64, device=env.device)
settings = {"rollouts": 64, "learning_epochs": 5, "mini_batches": 8, "discount_factor": 0.95}
agent = PPO(models={"policy": policy, "value": value}, memory=memory, cfg=settings, **spaces)
SequentialTrainer(env=env, agents=agent, cfg={"timesteps": 2_000, "headless": True}).train()
print(f"level 2: return {np.mean(arms.return_queue):.1f}")
