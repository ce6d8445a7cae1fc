"""Minari: 64 episodes of a classical servo, collected side by side, then read again."""

import minari

from servotrack.baselines import collect_dataset

NAME = "servo/lifted-kf-v0"
if NAME in minari.list_local_datasets():
    minari.delete_dataset(NAME)
collect_dataset(NAME, "UncalibServo-v0", "lifted-kf", range(1_000, 1_064), {"level": 2}, info_keys=["tracking_error"])
dataset = minari.load_dataset(NAME)
episode = next(dataset.iterate_episodes())
print(f"{dataset.total_episodes} episodes of {len(episode.rewards)} steps, level 2: return {sum(episode.rewards):.1f}")
