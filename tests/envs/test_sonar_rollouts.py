"""Short stored rollouts of the sonar environment, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_sonar_rollouts.py`
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

STORED = Path(__file__).with_name("sonar_rollouts.npz")
ENV_ID = "SonarTracking-v0"
SMALL = {"beams": 91, "elements": 16, "bin_width": 50.0, "snapshots": 50}
CASES: dict[str, dict[str, Any]] = {
    "rates": {"level": 0},
    "random": {"level": 2, "shortest_life": 10, **SMALL},
    "trial": {"level": 3, "shading": "chebyshev", **SMALL},
    "snapshots": {"level": 1, "fidelity": "snapshots", "snr_offset": -10.0, **SMALL},
}
SEED, HORIZON, LAG = 11, 16, 2
BEAMS = slice(None, None, 8)
"""Indices of the stored beams; neighboring beams are nearly equal."""


def answer_to(record: Any, env: Any) -> Any:
    """Return the loudest beams of two halves, so that every score is nonzero."""
    answer = np.zeros(env.action_space.shape)
    middle = len(record) // 2
    bearings = np.linspace(0.0, 180.0, len(record))
    answer[0] = [0.9, bearings[record[:middle].argmax()]]
    answer[1] = [0.9, bearings[middle + record[middle:].argmax()]]
    return answer


def rollout(case: str) -> dict[str, Any]:
    """Return the whole rollout, one array for each quantity."""
    env = gym.make(ENV_ID, horizon=HORIZON, lag=LAG, **CASES[case])
    record, info = env.reset(seed=SEED)
    rows = []
    for _ in range(HORIZON + LAG):
        truth = info["truth"]
        record, reward, _, _, info = env.step(answer_to(record, env))
        scores = {name: info[name] for name in ("scored", "ospa", "gospa")}
        rows.append({"record": record[BEAMS], "reward": reward, **truth, **scores})
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {"ospa2": np.array(info["ospa2"])}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: str) -> None:
    assert_as_stored(STORED, case, rollout(case))


def test_another_process_gets_the_same_bits_with_another_number_of_threads() -> None:
    # scripts/test runs the tests themselves with one.
    assert digests_elsewhere(__file__, OMP_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2") == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
