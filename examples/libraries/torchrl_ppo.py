"""TorchRL's collector, advantage and PPO loss on one arm."""

import gymnasium as gym
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import CatTensors, Compose, DoubleToFloat, GymWrapper, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from servotrack.envs import FlatSets

arm = GymWrapper(FlatSets(gym.make("UncalibServo-v0", level=2)))
keys = list(arm.observation_spec)
env = TransformedEnv(arm, Compose(DoubleToFloat(), CatTensors(keys, "observation"), RewardSum()))
network = nn.Sequential(MLP(out_features=4, num_cells=[64, 64]), NormalParamExtractor())
module = TensorDictModule(network, ["observation"], ["loc", "scale"])
policy = ProbabilisticActor(module, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)
critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64]))
start = critic(policy(env.reset()))  # sizes the layers
advantage, loss = GAE(gamma=0.95, lmbda=0.95, value_network=critic), ClipPPOLoss(policy, critic)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
for data in Collector(env, policy, frames_per_batch=2_000, total_frames=10_000):
    for _ in range(6):
        advantage(data)
        for batch in data[torch.randperm(len(data))].split(250):
            optimizer.zero_grad()
            sum(value for name, value in loss(batch).items() if name.startswith("loss_")).backward()
            optimizer.step()
ended = data["next", "done"].squeeze(-1)
print(f"level 2: return {data['next', 'episode_reward'][ended].mean():.1f}")
