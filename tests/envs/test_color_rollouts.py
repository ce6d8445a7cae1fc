"""Short stored rollouts of the color tracking environment, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_color_rollouts.py`
stores them anew. Of the frames, means over blocks of 5 x 5 px are kept.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stored_rollouts import digests, digests_elsewhere, stored_rollout

import servotrack  # noqa: F401
from servotrack.envs.track.color.config import LEVEL_NAMES

STORED = Path(__file__).with_name("color_rollouts.npz")
ENV_ID = "ColorTracking-v0"
LEVELS = range(len(LEVEL_NAMES))
SEED, STEPS, EVERY, BLOCK = 11, 60, 30, 5


def rollout(level: int) -> dict[str, Any]:
    """Return the whole rollout, one array for each quantity; only every 30th frame."""
    env = gym.make(ENV_ID, level=level, horizon=STEPS)
    observation, info = env.reset(seed=SEED)
    frames, boxes, rewards, errors = [observation["frame"]], [info["truth"]["box"]], [], []
    for step in range(1, STEPS + 1):
        observation, reward, _, _, info = env.step(observation["first_box"] + [2.0, 1.0, 0.5, 0.0])
        boxes.append(info["truth"]["box"])
        rewards.append(reward)
        errors.append(info["center_error"])
        if step % EVERY == 0:
            frames.append(observation["frame"])
    scores = [info["auc"], info["precision"], info["failures"]]
    found = {"frames": np.array(frames), "boxes": boxes, "rewards": rewards, "errors": errors, "scores": scores}
    return {name: np.asarray(values) for name, values in found.items()}


def blocks(frames: np.ndarray) -> np.ndarray:
    """Return the mean colors of blocks."""
    n, height, width, _ = frames.shape
    return frames.reshape(n, height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean(axis=(2, 4))


HASHED = (1, 5)
"""Two levels that together cover all drawing except distractors."""


@pytest.mark.parametrize("level", LEVELS)
def test_the_stored_rollout_comes_out_again(level: int) -> None:
    history = rollout(level)
    kept = stored_rollout(STORED, level)
    assert kept.keys() == history.keys()
    # Other versions of OpenCV round the camera's view differently.
    apart = np.abs(blocks(history.pop("frames")) - kept.pop("frames"))
    assert apart.mean() < 0.5
    assert apart.max() < 6.0
    for name, values in history.items():
        np.testing.assert_allclose(values, kept[name], rtol=1e-6, atol=1e-9, err_msg=name)


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, HASHED)


if __name__ == "__main__":
    if "--digests" in sys.argv:
        print("\n".join(digests(rollout, HASHED)))
    else:
        arrays = {}
        for level in LEVELS:
            history = rollout(level)
            history["frames"] = np.rint(blocks(history["frames"])).astype(np.uint8)
            arrays |= {f"{level}/{name}": values for name, values in history.items()}
        np.savez_compressed(STORED, **arrays)
