"""Raw observations as flat rows: every entry scaled by its own bounds, whatever the order of keys."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.envs.registration import ENVIRONMENTS

BOXES = ("ClutterTracking-v0", "PedestrianTracking-v0", "SonarTracking-v0", "VideoTracking-v0")
DICTS = sorted(set(ENVIRONMENTS) - set(BOXES))
ROWS, STEPS = 3, 25


def _rollout(env: gym.vector.VectorEnv[Any, Any, Any], encoding: Any) -> list[tuple[Any, np.ndarray]]:
    observation, _ = env.reset(seed=100_000)
    env.action_space.seed(0)
    pairs = []
    for _ in range(STEPS):
        pairs.append((observation, encoding.step((), observation, ())[1]))
        observation, *_ = env.step(env.action_space.sample())
    return pairs


@pytest.mark.parametrize("env_id", sorted(ENVIRONMENTS))
def test_every_entry_of_a_flat_row_lies_between_minus_one_and_one(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=ROWS)
    assert isinstance(env.single_observation_space, gym.spaces.Dict) == (env_id in DICTS)
    encoding = create_encoding({"kind": "flat"}, env)
    for _, row in _rollout(env, encoding):
        assert row.shape == (ROWS, encoding.size) and row.dtype == np.float32
        assert np.abs(row).max() <= 1.0
    env.close()


@pytest.mark.parametrize("env_id", DICTS)
def test_the_order_of_keys_has_no_effect_on_a_flat_row(env_id: str) -> None:
    env = gym.make_vec(env_id, num_envs=ROWS)
    encoding = create_encoding({"kind": "flat"}, env)
    for observation, row in _rollout(env, encoding)[::8]:
        backwards = dict(reversed(observation.items()))
        np.testing.assert_array_equal(encoding.step((), backwards, ())[1], row)
    env.close()


def test_an_entry_is_scaled_by_the_bounds_of_its_own_key() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=ROWS)
    encoding = create_encoding({"kind": "flat"}, env)
    for observation, row in _rollout(env, encoding):
        low, high = (
            np.concatenate([getattr(env.single_observation_space[key], side) for key in sorted(observation)])
            for side in ("low", "high")
        )
        restored = low + 0.5 * (row.astype(np.float64) + 1.0) * (high - low)
        entries = np.concatenate([observation[key] for key in sorted(observation)], axis=1)
        np.testing.assert_allclose(restored, entries, atol=1e-3)
