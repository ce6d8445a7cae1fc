"""The clutter environment passes the checkers of Gymnasium and Stable-Baselines3, single and vector; rendering."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs import FlatSets, VectorFlatSets
from servotrack.envs.drawing.plots import identity_color
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation

ENV_ID = "ClutterTracking-v0"


@pytest.mark.parametrize("level", [0, 4])
def test_gymnasiums_checker_is_content(level):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, level=level, horizon=20).unwrapped)


def test_stable_baselines3s_checker_is_content_through_flat_sets():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(FlatSets(gym.make(ENV_ID, horizon=20)))


def test_vector_environment_keeps_the_rules():
    check_vector_env(ENV_ID, horizon=8, steps=20)
    check_vector_env(ENV_ID, level=3, horizon=20, max_episode_steps=8, steps=20, skip=("rendering",))


@pytest.mark.parametrize("level", [0, 2, 4])
def test_vector_environment_is_the_single_one_to_the_bit(level):
    check_vector_matches_single(ENV_ID, level=level, horizon=12)


def test_flat_sets_scale_to_and_fro():
    env = gym.make(ENV_ID, horizon=5)
    flat = FlatSets(env)
    observation, _ = flat.reset(seed=0)
    plain, _ = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert observation in flat.observation_space
    bound = env.observation_space.high[0, 1]
    assert np.allclose(observation.reshape(plain.shape)[:, 1:] * bound, plain[:, 1:], atol=1e-3)
    assert np.array_equal(observation.reshape(plain.shape)[:, 0], 2 * plain[:, 0] - 1)
    silent = -np.ones(flat.action_space.shape, np.float32)
    _, reward, *_ = flat.step(silent)
    env.reset(seed=0)
    _, expected, *_ = env.step(np.zeros(env.action_space.shape))
    assert reward == expected


def test_flat_sets_of_a_vector_environment_are_the_single_ones():
    vector = VectorFlatSets(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", horizon=5))
    singles = [FlatSets(gym.make(ENV_ID, horizon=5)) for _ in range(2)]
    observations, _ = vector.reset(seed=3)
    for row, env in enumerate(singles):
        assert np.array_equal(observations[row], env.reset(seed=3 + row)[0])
    actions = vector.action_space.sample()
    observations, rewards, *_ = vector.step(actions)
    for row, env in enumerate(singles):
        observation, reward, *_ = env.step(actions[row])
        assert np.array_equal(observation, observations[row])
        assert reward == rewards[row]


def test_flat_sets_refuse_other_spaces():
    with pytest.raises(TypeError, match="observation space must be a Box with finite bounds"):
        FlatSets(gym.make("CartPole-v1"))


def test_privileged_observation_puts_the_truth_beside_the_scan():
    env = PrivilegedObservation(gym.make(ENV_ID))
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert np.array_equal(observation["true_source"], info["truth"]["source"])
    vector = VectorPrivilegedObservation(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point"))
    observations, _ = vector.reset(seed=0)
    assert np.array_equal(observations["observation"][0], observation["observation"])


def test_pictures_show_answers_and_change_nothing():
    env = gym.make(ENV_ID, render_mode="rgb_array").unwrapped
    blind = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    blind.reset(seed=0)
    before = env.render()
    assert before.shape == (544, 800, 3)
    assert before.dtype == np.uint8
    answer = np.zeros(env.action_space.shape)
    for step in range(30):
        answer[0] = [0.9, 50.0 * step - 700.0, -1500.0]
        observation, *_ = env.step(answer)
        same, *_ = blind.step(answer)
        assert np.array_equal(observation, same)
    after = env.render()
    count = (after == identity_color(0)).all(axis=2).sum()
    assert count > 30
    assert not (before == identity_color(0)).all(axis=2).any()
    assert blind.render() is None


def test_answers_far_outside_do_not_break_the_picture():
    env = gym.make(ENV_ID, render_mode="rgb_array", level=4)
    env.reset(seed=0)
    answer = np.zeros(env.action_space.shape)
    answer[:] = [1.0, 1e12, -1e12]
    env.step(answer)
    assert env.render().shape == (544, 800, 3)
