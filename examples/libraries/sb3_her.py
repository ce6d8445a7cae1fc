"""Stable-Baselines3's SAC with hindsight experience replay, on the goal form of positioning."""

import gymnasium as gym
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy

from servotrack.envs import GoalObservation

env = GoalObservation(gym.make("UncalibServoReach-v0", level=2))
relabel = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
model = SAC(
    "MultiInputPolicy",
    env,
    learning_starts=1_000,
    replay_buffer_class=HerReplayBuffer,
    replay_buffer_kwargs=relabel,
    seed=0,
).learn(3_000)
mean, _ = evaluate_policy(model, env, n_eval_episodes=10)
print(f"positioning, level 2, sparse reward: return {mean:.1f}")
