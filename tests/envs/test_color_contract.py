"""The color environment passes the checkers of Gymnasium and Stable-Baselines3, single and vector; rendering."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.baselines import create_agent
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.track.color.render import ANSWER
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation

ENV_ID = "ColorTracking-v0"
SMALL = {"width": 120, "height": 96, "head_height": 24.0}


@pytest.mark.parametrize("level", [0, 5])
def test_gymnasiums_checker_is_content(level: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, level=level, normalized_actions=True, horizon=10, **SMALL).unwrapped)


def test_stable_baselines3s_checker_is_content_with_normalized_actions() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gym.make(ENV_ID, normalized_actions=True, horizon=10, **SMALL).unwrapped)


def test_normalized_actions_are_boxes_in_pixels_on_another_scale() -> None:
    pixels, normalized = gym.make(ENV_ID, horizon=5), gym.make(ENV_ID, horizon=5, normalized_actions=True)
    space: Any = pixels.action_space
    assert normalized.action_space == gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    box = pixels.reset(seed=4)[0]["first_box"]
    normalized.reset(seed=4)
    moved = box + np.array([3.0, -2.0, 1.0, 0.0])
    _, reward, *_ = pixels.step(moved)
    _, same, *_ = normalized.step(2.0 * (moved - space.low) / (space.high - space.low) - 1.0)
    assert 0.5 < float(reward) < 1.0 and same == pytest.approx(reward, abs=1e-9)


def test_normalized_actions_are_the_same_in_a_vector_environment() -> None:
    check_vector_matches_single(ENV_ID, horizon=4, normalized_actions=True, **SMALL)


@pytest.mark.parametrize("value", [1, "yes", None])
def test_other_values_of_normalized_actions_are_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="normalized_actions must be True or False"):
        gym.make(ENV_ID, normalized_actions=value)


def test_classical_agents_refuse_normalized_actions() -> None:
    with pytest.raises(ValueError, match="make the environment without normalized_actions"):
        create_agent("first-box", gym.make(ENV_ID, normalized_actions=True))


def test_vector_environment_keeps_the_rules() -> None:
    check_vector_env(ENV_ID, horizon=5, steps=8, **SMALL)


@pytest.mark.parametrize("level", [1, 5])
def test_vector_environment_is_the_single_one_to_the_bit(level: int) -> None:
    check_vector_matches_single(ENV_ID, level=level, horizon=5, steps=8, num_envs=2, interrupt_after=3, **SMALL)


def test_privileged_observation_puts_the_true_box_beside_the_frame() -> None:
    env = PrivilegedObservation(gym.make(ENV_ID, **SMALL))
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert np.array_equal(observation["true_box"], info["truth"]["box"])
    vector = VectorPrivilegedObservation(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", **SMALL))
    observations, _ = vector.reset(seed=0)
    assert np.array_equal(observations["true_box"][0], observation["true_box"])


def test_pictures_show_the_frame_that_was_answered_and_change_nothing() -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array").unwrapped
    blind = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    blind.reset(seed=0)
    before = env.render()
    assert before.shape == (522, 856, 3)
    answer = np.array([40.0, 50.0, 60.0, 70.0])
    for _ in range(5):
        seen, *_ = env.step(answer)
        same, *_ = blind.step(answer)
        assert np.array_equal(seen["frame"], same["frame"])
    after = env.render()
    box = after[16 + 100 : 16 + 240, 16 + 80 : 16 + 200]
    assert (box == ANSWER).all(axis=2).sum() > 300
    assert not (before == ANSWER).all(axis=2).any()
    assert blind.render() is None


def test_answers_far_outside_do_not_break_the_picture() -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    env.step(np.array([1e9, -1e9, 1e9, 0.0]))
    assert env.render().dtype == np.uint8
