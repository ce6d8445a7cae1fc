"""Minari's own collector around one environment, with its infos."""

import gymnasium as gym
import minari

from servotrack.baselines import create_agent

NAME = "servo/kf-v0"
if NAME in minari.list_local_datasets():
    minari.delete_dataset(NAME)
env = minari.DataCollector(gym.make("UncalibServo-v0", level=2), record_infos=True)
agent = create_agent("kf", env)
for seed in range(1_000, 1_010):
    (observation, _), state, over = env.reset(seed=seed), None, False
    while not over:
        action, state = agent.predict(observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
dataset = env.create_dataset(NAME)
print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps")
