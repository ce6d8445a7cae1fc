"""PedestrianServo follows the rules of Gymnasium and Stable-Baselines3, single and vector."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation

ENV_ID = "PedestrianServo-v0"
KINDS = [{"observation": "detections"}, {"observation": "pixels", "image_size": 32}, {"observation": "identity"}]


@pytest.mark.parametrize("keywords", KINDS)
@pytest.mark.parametrize("level", [2, 6])
def test_gymnasiums_checker_is_content(level, keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, level=level, horizon=30, **keywords).unwrapped)


@pytest.mark.parametrize("keywords", KINDS)
def test_stable_baselines3s_checker_is_content(keywords):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Warnings about its own networks, which need larger images and do not accept tables.
        warnings.filterwarnings("ignore", message="The minimal resolution for an image is 36x36")
        warnings.filterwarnings("ignore", message="Your observation detections has an unconventional shape")
        checker.check_env(gym.make(ENV_ID, horizon=30, **keywords))


def test_vector_environment_keeps_the_rules():
    check_vector_env(ENV_ID, horizon=6, steps=20)


@pytest.mark.parametrize(
    "keywords",
    [{"level": 1}, {"level": 6, "observation": "pixels", "image_size": 32}, {"level": 5, "observation": "identity"}],
)
def test_vector_environment_is_the_single_one_to_the_bit(keywords):
    check_vector_matches_single(ENV_ID, horizon=8, **keywords)


def test_privileged_observations_of_oracles():
    env = PrivilegedObservation(gym.make(ENV_ID, level=0))
    observation, _ = env.reset(seed=3)
    assert observation in env.observation_space
    left, top, width, height = observation["target_box"]
    np.testing.assert_allclose(observation["true_people"][0, 1:5], [left + width / 2, top + height / 2, width, height])
    vector = VectorPrivilegedObservation(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point"))
    observations, _ = vector.reset(seed=0)
    assert observations["true_people"].shape == (2, 6, 8)
    assert observations["true_jacobian"].shape == (2, 2, 3)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"observation": "features"}, "observation must be one of pixels, detections, identity, got 'features'"),
        ({"people": 0}, r"people must lie in \[1, 16\], got 0"),
        ({"people": 2.5}, "people must be a whole number, got 2.5"),
        ({"companions": 6}, "companions must be at most people - 1 = 5, got 6; raise `people`"),
        ({"umbrellas": 7}, "umbrellas must be at most people - 1 = 5, got 7"),
        ({"pace": (1.5, 0.5)}, "pace must be a number or .low, high. with low <= high"),
        ({"pace": 3.0}, r"pace must lie in \[0.1, 2\] m/s"),
        ({"script": "dance"}, "script must be one of plaza, crossings, got 'dance'"),
        ({"misses": float("nan")}, r"misses must lie in \[0, 0.95\], got nan"),
        ({"target": "ellipse"}, "target must be one of person, got 'ellipse'"),
        ({"level": 7}, "level must be a whole number from 0 to 6"),
        ({"image_size": 8, "observation": "pixels"}, "image_size must be a whole number of 32 to 480 px, got 8"),
    ],
)
def test_bad_arguments_are_named(keywords, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ENV_ID, **keywords)


def test_an_unknown_axis_is_answered_with_the_nearest():
    with pytest.raises(TypeError, match="unexpected keyword argument 'lookalikes'; did you mean 'look_alikes'"):
        gym.make(ENV_ID, lookalikes=0.5)


@pytest.mark.parametrize("action", [np.full(2, np.nan), np.zeros(3)])
def test_bad_actions_are_refused(action):
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must"):
        env.step(action)


def test_the_picture_shows_where_an_agent_believes_the_person_to_be_and_changes_nothing():
    env, blind = gym.make(ENV_ID, render_mode="rgb_array").unwrapped, gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    blind.reset(seed=0)
    before = env.render()
    env.belief = (100.0, 300.0)
    assert (env.render() != before).any()
    same = [e.step(np.array([0.1, -0.1]))[0]["detections"] for e in (env, blind)]
    assert np.array_equal(*same)
    env.reset(seed=0)
    assert env.belief is None
    assert np.array_equal(env.render(), before)
