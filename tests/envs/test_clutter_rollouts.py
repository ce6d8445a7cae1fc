"""Short stored rollouts of the clutter environment, which detect unintended changes of behavior.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_clutter_rollouts.py`
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

STORED = Path(__file__).with_name("clutter_rollouts.npz")
ENV_ID = "ClutterTracking-v0"
LEVELS = (0, 1, 3, 4, 7)
SCENARIOS = ("vo-ma-2006", "vo-ma-2006-pair", "vo-demo", "williams-2015", "garcia-fernandez-2018", "pinto-2021")
CASES: tuple[int | str, ...] = (*LEVELS, *SCENARIOS)
SEED, STEPS = 11, 12


def answer_to(scan: Any, env: Any) -> Any:
    """Return the measurements, scaled slightly so that every score is nonzero."""
    answer = np.zeros(env.action_space.shape)
    kept = min(len(answer), len(scan))
    answer[:kept] = scan[:kept]
    answer[:, 1:] *= 0.99
    return answer


def rollout(case: int | str) -> dict[str, Any]:
    """Return the whole rollout of a level or a scenario, one array for each quantity."""
    own = {"level": case} if isinstance(case, int) else {"scenario": case}
    env = gym.make(ENV_ID, **own, horizon=STEPS)
    scan, info = env.reset(seed=SEED)
    rows = []
    for _ in range(STEPS):
        truth = info["truth"]
        scan, reward, _, _, info = env.step(answer_to(scan, env))
        rows.append({"scan": scan, "reward": reward, **truth, "ospa": info["ospa"], "gospa": info["gospa"]})
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {"ospa2": np.array(info["ospa2"])}


@pytest.mark.parametrize("case", CASES)
def test_the_stored_rollout_comes_out_again(case: int | str) -> None:
    assert_as_stored(STORED, case, rollout(case))


def test_another_process_gets_the_same_bits() -> None:
    assert digests_elsewhere(__file__) == digests(rollout, CASES)


if __name__ == "__main__":
    print_or_store(STORED, rollout, CASES)
