"""Short stored rollouts of PedestrianServo: a change of behavior fails here.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_follow_rollouts.py`
stores them anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stored_rollouts import assert_as_stored, digests, digests_elsewhere, print_or_store

import servotrack  # noqa: F401

STORED = Path(__file__).with_name("follow_rollouts.npz")
ENV_ID = "PedestrianServo-v0"
CASES: dict[str, dict[str, Any]] = {
    "plain": {"level": 0},
    "geometry": {"level": 2, "script": "crossings"},
    "heavy": {"level": 6},
    "pixels": {"level": 5, "observation": "pixels", "image_size": 48},
    "identity": {"level": 4, "observation": "identity"},
}
SEED, STEPS, EVERY_IMAGE = 11, 30, 10
SCORES = ("tracking_error", "feature_error", "time_on_target", "identity_error", "lost", "losses", "kept")
IMAGES = ("image", "target_patch")


def rollout(case: str) -> dict[str, Any]:
    """Everything that comes back, one array for each quantity; of images every tenth."""
    env = gym.make(ENV_ID, disable_env_checker=True, **CASES[case])
    observation, info = env.reset(seed=SEED)
    rows = []
    for step in range(STEPS):
        sweep = 0.3 * np.array([np.sin(0.4 * step), np.cos(0.3 * step)])
        rows.append(observation | info["truth"] | {name: float(info[name]) for name in SCORES})
        observation, reward, _, _, info = env.step(sweep)
        rows[-1]["reward"] = reward
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: value[::EVERY_IMAGE] if name in IMAGES else value for name, value in arrays.items()}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case), IMAGES)


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
