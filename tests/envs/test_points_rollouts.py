"""Short stored rollouts of recorded points, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_points_rollouts.py`
stores them anew.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stored_rollouts import assert_as_stored, digests, digests_elsewhere, print_or_store

import servotrack  # noqa: F401

STORED = Path(__file__).with_name("points_rollouts.npz")
ENV_ID = "RecordedPoints-v0"
CASES: dict[str, dict[str, Any]] = {
    "drawn": {"horizon": 20},
    "file": {"lag": 2, "cutoff": 20.0},
    "part": {"start": 2, "horizon": 5, "max_estimates": 6},
}
SCANS = 12


def write_points(folder: Path) -> dict[str, str]:
    """Write a file of points in three dimensions with a truth of two targets that begins late and ends early."""
    points, truth = ["time,x,y,z"], ["time,id,x,y,z"]
    for k in range(SCANS):
        time = k + 0.4 * (k % 3)
        for name, (x, y, z) in {"a": (10.0 + 3.0 * time, 5.0, 2.0), "b": (60.0 - 2.0 * time, 8.0 + time, 3.0)}.items():
            if (k + len(points)) % 4:
                points.append(f"{time},{x + 0.2},{y - 0.1},{z + 0.3}")
            if 1 <= k < SCANS - 1 and not (name == "b" and k < 4):
                truth.append(f"{time},{name},{x},{y},{z}")
        points.append(f"{time},{(37 * k) % 80},{(11 * k) % 20},{k % 5}")
    (folder / "points.csv").write_text("\n".join(points) + "\n")
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    return {"source": str(folder / "points.csv"), "truth": str(folder / "truth.csv")}


def rollout(case: str) -> dict[str, Any]:
    """Return the whole rollout, one array for each quantity. Answers are slightly shifted true positions."""
    with tempfile.TemporaryDirectory() as name:
        files = {} if case == "drawn" else write_points(Path(name))
        env = gym.make(ENV_ID, **files, **CASES[case])
        seen, info = env.reset(seed=3)
        rows, over = [], False
        while not over:
            truth, answer = info["truth"], np.zeros(env.action_space.shape)
            present = np.flatnonzero(truth["exists"])
            answer[present, 0], answer[present, 1:] = 1.0, truth["positions"][present] + 0.5
            shown = seen
            seen, reward, _, over, info = env.step(answer)
            rows.append({**shown, "reward": reward, **truth, "ospa": info["ospa"], "scored": info["scored"]})
        env.close()
    return {name: np.array([row[name] for row in rows]) for name in rows[0]} | {"ospa2": np.array(info["ospa2"])}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case), tolerance=1e-9)


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
