"""Short stored rollouts of the pedestrian environment, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_pedestrian_rollouts.py`
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

STORED = Path(__file__).with_name("pedestrian_rollouts.npz")
ENV_ID = "PedestrianTracking-v0"
CASES: dict[str, dict[str, Any]] = {
    "plain": {"empty_frames": 2},
    "everything": {"level": 5, "observation": "blobs", "empty_frames": 0},
    "points": {"level": 1, "observation": "centroids", "empty_frames": 3, "people": 8.0},
}
SEED, STEPS, BLOCK = 11, 8, 24


def rollout(case: str) -> dict[str, Any]:
    """Return the whole rollout, one array for each quantity; block means of images."""
    env = gym.make(ENV_ID, horizon=STEPS, **CASES[case])
    seen, info = env.reset(seed=SEED)
    rows = []
    for _ in range(STEPS):
        truth, answer = info["truth"], np.zeros(env.action_space.shape)
        n = len(truth["ids"])
        answer[:n, 0] = truth["ids"] > 0
        boxes = truth["boxes"] + [3.0, 2.0, 1.0, 0.0]
        answer[:n, 1:] = boxes if answer.shape[1] == 5 else boxes[:, :2]
        shown = seen
        if seen.ndim == 3:
            shown = seen.reshape(288 // BLOCK, BLOCK, 384 // BLOCK, BLOCK, 3).mean(axis=(1, 3))
        seen, reward, _, _, info = env.step(answer)
        rows.append({"seen": shown, "reward": reward, **truth, "ospa": info["ospa"]})
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {name: np.array(info[name]) for name in ("ospa2", "mota", "idf1", "hota")}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case), images=("seen",) if case == "plain" else ())


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
