"""The sonar environment passes the checkers of Gymnasium and Stable-Baselines3, single and vector; rendering."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs import FlatSets
from servotrack.envs.drawing.plots import identity_color
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.track.sonar.render import MAX_RECORDS, WATERFALL, paint_powers
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation

ENV_ID = "SonarTracking-v0"
SMALL = {"beams": 91, "elements": 16, "bin_width": 50.0, "snapshots": 50}
"""Arguments of a small receiver with fast records; these tests do not depend on its size."""


@pytest.mark.parametrize("level", [0, 3, 5])
def test_gymnasiums_checker_is_content(level):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, level=level, horizon=20, **SMALL).unwrapped)


def test_stable_baselines3s_checker_is_content_through_flat_sets():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(FlatSets(gym.make(ENV_ID, horizon=20, **SMALL)))


def test_vector_environment_keeps_the_rules():
    check_vector_env(ENV_ID, horizon=6, lag=2, steps=20, **SMALL)


@pytest.mark.parametrize("keywords", [{"level": 0}, {"level": 2, "lag": 0}, {"level": 1, "fidelity": "snapshots"}])
def test_vector_environment_is_the_single_one_to_the_bit(keywords):
    check_vector_matches_single(ENV_ID, horizon=8, **keywords, **SMALL)


def test_privileged_observation_is_the_truth_that_the_next_answer_is_judged_by():
    env = PrivilegedObservation(gym.make(ENV_ID, level=1, lag=3, **SMALL))
    observation, _ = env.reset(seed=0)
    assert not observation["true_existence"].any()
    truncated, total = False, 0.0
    while not truncated:
        assert observation in env.observation_space
        answer = np.zeros(env.action_space.shape)
        answer[: len(observation["true_existence"])] = np.stack(
            [observation["true_existence"], observation["true_bearings"]], axis=1
        )
        observation, reward, _, truncated, info = env.step(answer)
        total += reward
    assert total == 0.0
    assert info["ospa2"] == 0.0
    vector = VectorPrivilegedObservation(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", **SMALL))
    assert vector.reset(seed=0)[0]["true_bearings"].shape == (2, 6)


def test_pictures_show_answers_and_change_nothing():
    env = gym.make(ENV_ID, level=1, render_mode="rgb_array", **SMALL).unwrapped
    blind = gym.make(ENV_ID, level=1, **SMALL).unwrapped
    env.reset(seed=0)
    blind.reset(seed=0)
    before = env.render()
    assert before.shape == (544, 800, 3)
    assert before.dtype == np.uint8
    answer = np.zeros(env.action_space.shape)
    for step in range(40):
        answer[0] = [0.9, 20.0 + step]
        observation, *_ = env.step(answer)
        same, *_ = blind.step(answer)
        assert np.array_equal(observation, same)
    after = env.render()
    assert (after == identity_color(0)).all(axis=2).sum() > 30
    assert not (before == identity_color(0)).all(axis=2).any()
    assert blind.render() is None


def test_a_target_is_a_dark_ridge_where_it_is():
    env = gym.make(ENV_ID, level=0, render_mode="rgb_array", bearing_jitter=0.0, rate_jitter=0.0).unwrapped
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.zeros(env.action_space.shape))
    panel = WATERFALL.of(env.render())
    # The newest record shown is number 19, in which the paper's targets are at 54 and 96 deg.
    row = panel[round(WATERFALL.height * 19.5 / 65)].astype(np.int64).sum(axis=1)
    x = [round(b / 180 * (WATERFALL.width - 1)) for b in (54.0, 96.0, 20.0)]
    assert row[x[0] - 2 : x[0] + 3].min() < 350
    assert row[x[1] - 2 : x[1] + 3].min() < 300
    assert row[x[2] - 2 : x[2] + 3].min() > 600


def test_long_records_run_out_at_the_top_and_far_answers_do_not_break_the_picture():
    env = gym.make(ENV_ID, horizon=MAX_RECORDS + 20, render_mode="rgb_array", **SMALL).unwrapped
    env.reset(seed=0)
    answer = np.zeros(env.action_space.shape)
    answer[:] = [1.0, -1e12]
    for _ in range(MAX_RECORDS + 10):
        env.step(answer)
    assert env.render().shape == (544, 800, 3)


def test_a_waterfall_shows_every_record_and_noise_is_pale():
    records = np.ones((3, 721))
    records[1, 350:371] = 20.0
    image = paint_powers(records, 1110, (181, 30)).astype(np.int64).sum(axis=2)
    assert image[:10].min() > 700
    assert image[20:].min() > 700
    assert image[10:20, 90].max() < 400
