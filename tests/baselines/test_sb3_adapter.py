"""The Stable-Baselines3 adapter against Gymnasium's own account of the same steps."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401

pytest.importorskip("stable_baselines3")

from servotrack.baselines.training.sb3 import StableBaselinesVecEnv

SAME_STEP = gym.vector.AutoresetMode.SAME_STEP
SHORT = {"level": 2, "horizon": 5}


def make(count: int = 3, **kwargs: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    return gym.make_vec("UncalibServo-v0", num_envs=count, autoreset_mode=SAME_STEP, **{**SHORT, **kwargs})


def test_steps_are_those_of_the_vector_environment() -> None:
    adapter, plain = StableBaselinesVecEnv(make()), make()
    adapter.seed(11)
    observation = adapter.reset()
    expected, _ = plain.reset(seed=[11, 12, 13])
    rng = np.random.default_rng(0)
    for step in range(12):
        assert all(np.array_equal(observation[key], expected[key]) for key in expected)
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        observation, rewards, dones, infos = adapter.step(actions)
        expected, reward, terminated, truncated, info = plain.step(actions)
        assert np.array_equal(rewards, reward.astype(np.float32))
        assert np.array_equal(dones, terminated | truncated)
        assert dones.all() == ((step + 1) % 5 == 0)
        for row in range(3):
            if dones[row]:
                final = infos[row]["terminal_observation"]
                assert all(np.array_equal(final[key], info["final_obs"][row][key]) for key in final)
                assert infos[row]["TimeLimit.truncated"]
                assert infos[row]["tracking_error"] == info["final_info"]["tracking_error"][row]
                assert np.array_equal(infos[row]["truth"]["tool"], info["final_info"]["truth"]["tool"][row])
            else:
                assert infos[row]["tracking_error"] == info["tracking_error"][row]
                assert "terminal_observation" not in infos[row]
                assert np.array_equal(infos[row]["truth"]["tool"], info["truth"]["tool"][row])


def test_an_id_is_made_in_the_mode_that_it_needs() -> None:
    adapter, given = StableBaselinesVecEnv("UncalibServo-v0", num_envs=3, **SHORT), StableBaselinesVecEnv(make())
    for env in (adapter, given):
        env.seed(11)
    assert np.array_equal(adapter.reset()["features"], given.reset()["features"])
    foreign = StableBaselinesVecEnv("CartPole-v1", num_envs=2)
    assert foreign.reset().shape == (2, 4)
    for _ in range(60):
        _, _, dones, infos = foreign.step(np.zeros(2, dtype=np.int64))
        assert all("terminal_observation" in infos[row] for row in np.flatnonzero(dones))
    with pytest.raises(ValueError, match=r"num_envs and arguments of the environment go with an id, got num_envs=2"):
        StableBaselinesVecEnv(make(), num_envs=2)


def test_seeds_last_for_one_reset() -> None:
    adapter = StableBaselinesVecEnv(make())
    adapter.seed(5)
    first = adapter.reset()
    second = adapter.reset()
    adapter.seed(5)
    third = adapter.reset()
    assert np.array_equal(first["features"], third["features"])
    assert not np.array_equal(first["features"], second["features"])


def test_chosen_infos_only() -> None:
    adapter = StableBaselinesVecEnv(make(), info_keys=["success"])
    adapter.reset()
    for _ in range(5):
        _, _, dones, infos = adapter.step(np.zeros((3, 2), np.float32))
        wanted = {"success", "TimeLimit.truncated"} | ({"terminal_observation"} if dones[0] else set())
        assert set(infos[0]) == wanted


def test_attributes_and_methods_reach_the_environment() -> None:
    adapter = StableBaselinesVecEnv(make())
    assert adapter.get_attr("max_joint_rate") == [2.0, 2.0, 2.0]
    assert adapter.get_attr("level", indices=1) == [2]
    adapter.reset()
    assert len(adapter.env_method("privileged")) == 3
    assert adapter.env_is_wrapped(gym.Wrapper) == [False, False, False]
    adapter.set_attr("level", 4)
    assert adapter.get_attr("level") == [4, 4, 4]
    with pytest.raises(ValueError, match="all 3 rows at once"):
        adapter.set_attr("level", 1, indices=[0])
    with pytest.raises(AttributeError):
        adapter.get_attr("no_such_attribute")
    adapter.close()


def test_frames_come_one_per_row() -> None:
    adapter = StableBaselinesVecEnv(make(2, render_mode="rgb_array"))
    adapter.reset()
    images = adapter.get_images()
    assert len(images) == 2
    assert images[0] is not None and images[0].ndim == 3


def test_other_reset_modes_are_refused() -> None:
    with pytest.raises(ValueError, match="must be SAME_STEP"):
        StableBaselinesVecEnv(gym.make_vec("UncalibServo-v0", num_envs=2))


def test_an_algorithm_learns_through_it() -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    env = VecMonitor(StableBaselinesVecEnv(make(4, level=0), info_keys=["success"]))
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [value.clone() for value in model.policy.parameters()]
    model.learn(64)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer or ()) > 0


@pytest.mark.parametrize("adapter", [True, False])
def test_the_rate_of_success_is_logged(adapter: bool) -> None:
    """Stable-Baselines3 reads `is_success` from the last info of an episode."""
    algorithms = pytest.importorskip("stable_baselines3")
    env: Any = StableBaselinesVecEnv(make()) if adapter else gym.make("UncalibServo-v0", **SHORT)  # type: ignore[arg-type]
    model = algorithms.PPO("MultiInputPolicy", env, n_steps=20, batch_size=20, n_epochs=1, device="cpu")
    model.learn(20)
    assert len(model.ep_success_buffer) >= 4 and set(model.ep_success_buffer) <= {True, False}
