"""Short stored rollouts of UncalibServo3D: a change of behavior fails here.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_servo3d_rollouts.py`
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

STORED = Path(__file__).with_name("servo3d_rollouts.npz")
ENV_ID = "UncalibServo3D-v0"
TWO_JOINTS = {
    "name": "two joints",
    "axes": [[0, 0, 1], [0, 0, 1]],
    "points": [[0, 0, 0.3], [0.4, 0, 0.3]],
    "tool": [[1, 0, 0, 0.7], [0, -1, 0, 0], [0, 0, -1, 0.3], [0, 0, 0, 1]],
    "low": [-2.5, -2.5],
    "high": [2.5, 2.5],
    "masses": [1.0, 1.0],
    "ready": [0.3, 1.2],
}
CASES: dict[str, dict[str, Any]] = {
    "plain": {"level": 0, "arm": "so101"},
    "hobby": {"level": 2, "arm": "panda", "camera": "world"},
    "play": {"level": 3, "arm": "ur5e", "points": 20},
    "hidden": {"level": 4, "arm": "so101", "camera": "world"},
    "turns": {"level": 5, "arm": "panda"},
    "everything": {"level": 6, "arm": "ur5e", "camera": "world"},
    "moving": {"level": 6, "arm": "so101"},
    "point": {"level": 2, "arm": "so101", "points": 1},
    "mapping": {"level": 1, "arm": TWO_JOINTS, "mounting_tilt": 0.0, "board_tilt": 0.1, "zoom": 1.0, "turn": 0.1},
}
SEED, STEPS = 11, 30
SCORES = ("tip_error", "tip_angle", "tracking_error", "feature_error", "at_limit", "success")


def rollout(case: str) -> dict[str, Any]:
    """Everything that comes back, one array for each quantity, and the true Jacobian at the end."""
    env: Any = gym.make(ENV_ID, disable_env_checker=True, **CASES[case]).unwrapped
    observation, info = env.reset(seed=SEED)
    rows, joints = [], np.arange(env.action_space.shape[0])
    for step in range(STEPS):
        rows.append(observation | info["truth"] | {name: float(info[name]) for name in SCORES})
        observation, reward, _, _, info = env.step(0.3 * np.sin(0.4 * step + joints))
        rows[-1]["reward"] = reward
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {"true_jacobian": env.privileged()["true_jacobian"]}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case))


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
