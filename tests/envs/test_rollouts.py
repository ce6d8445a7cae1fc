"""Short stored rollouts of every servo id: a change of behavior fails here.

A change of behavior means a new version of the id. Where one is meant, `python tests/envs/test_rollouts.py` stores them
anew.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS

STORED = Path(__file__).with_name("rollouts.npz")
WORLDS = [
    *(("UncalibServo-v0", level) for level in range(7)),
    *(("UncalibServoReach-v0", level) for level in (0, 3)),
    *(("UncalibServoPixels-v0", level) for level in (3, 6)),
]
SEED, STEPS, EVERY_IMAGE = 11, 40, 20
NAMES = [f"{env_id}/{level}" for env_id, level in WORLDS]


def arguments(env_id: str, level: int) -> dict[str, Any]:
    return {"level": level} | ({"image_size": 32} if "Pixels" in env_id else {})


def actions() -> Any:
    """Sweeps of both joints and, from time to time, a push."""
    step = np.arange(STEPS)
    sweeps = np.stack([0.3 * np.sin(0.4 * step), 0.3 * np.cos(0.3 * step)], axis=1)
    sweeps[::10] = 0.9
    return sweeps.astype(np.float32)


def rollout(env_id: str, level: int) -> dict[str, Any]:
    """All returned values, one array (STEPS + 1, ...) for each quantity."""
    env = gym.make(env_id, disable_env_checker=True, **arguments(env_id, level))
    observation, info = env.reset(seed=SEED)
    rows = [observation | {"reward": 0.0, "tracking_error": info["tracking_error"]} | info["truth"]]
    for action in actions():
        observation, reward, terminated, truncated, info = env.step(action)
        assert not truncated
        if terminated:
            break
        rows.append(observation | {"reward": reward, "tracking_error": info["tracking_error"]} | info["truth"])
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def digest(history: dict[str, Any]) -> str:
    sha = hashlib.sha256()
    for name in sorted(history):
        sha.update(name.encode() + np.ascontiguousarray(history[name]).tobytes())
    return sha.hexdigest()


def all_digests() -> list[str]:
    return [digest(rollout(env_id, level)) for env_id, level in WORLDS]


def store() -> None:
    """Write the rollouts of the current environments."""
    arrays = {}
    for env_id, level in WORLDS:
        for name, values in rollout(env_id, level).items():
            arrays[f"{env_id}/{level}/{name}"] = values[::EVERY_IMAGE] if name == "image" else values
    np.savez_compressed(STORED, **arrays)


def test_every_id_is_stored() -> None:
    planar = {name for name, entry in ENVIRONMENTS.items() if entry["entry_point"].startswith("servotrack.envs.servo.")}
    assert {env_id for env_id, _ in WORLDS} == planar


@pytest.mark.parametrize(("env_id", "level"), WORLDS, ids=NAMES)
def test_the_stored_rollout_comes_out_again(env_id: str, level: int) -> None:
    history = rollout(env_id, level)
    with np.load(STORED) as stored:
        prefix = f"{env_id}/{level}/"
        assert {name.removeprefix(prefix) for name in stored if name.startswith(prefix)} == history.keys()
        for name, values in history.items():
            expected = stored[prefix + name]
            if name == "image":
                assert np.abs(values[::EVERY_IMAGE].astype(float) - expected).mean() < 1.0
            else:
                np.testing.assert_allclose(values, expected, rtol=1e-6, atol=1e-9, err_msg=prefix + name)


def test_another_process_gets_the_same_bits() -> None:
    out = subprocess.run(
        [sys.executable, __file__, "--digests"], capture_output=True, text=True, check=True, timeout=300
    )
    assert out.stdout.split() == all_digests()


@pytest.mark.parametrize(("env_id", "level"), WORLDS, ids=NAMES)
def test_a_vector_environment_gets_the_same_bits(env_id: str, level: int) -> None:
    alone = rollout(env_id, level)
    env = gym.make_vec(env_id, num_envs=5, **arguments(env_id, level))
    observations, infos = env.reset(seed=[1, 2, SEED, 3, 4])
    history: list[Any] = []
    moves = np.random.default_rng(0).uniform(-1, 1, (STEPS, 5, 2)).astype(np.float32)
    moves[:, 2] = actions()
    rewards = np.zeros(5)
    for step in range(len(alone["time"])):
        values = observations | {"reward": rewards, "tracking_error": infos["tracking_error"]}
        values |= {name: value for name, value in infos["truth"].items() if not name.startswith("_")}
        history.append({name: value[2].copy() for name, value in values.items()})
        if step + 1 < len(alone["time"]):
            observations, rewards, _, _, infos = env.step(moves[step])
    assert digest({name: np.array([row[name] for row in history]) for name in history[0]}) == digest(alone)


if __name__ == "__main__":
    if "--digests" in sys.argv:
        print("\n".join(all_digests()))
    else:
        store()
