"""The pedestrian environment passes the checkers of Gymnasium and Stable-Baselines3, single and vector; rendering."""

from __future__ import annotations

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs import FlatSets
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.track.pedestrians import scripts
from servotrack.envs.wrappers import PrivilegedObservation

ENV_ID = "PedestrianTracking-v0"
SMALL = {"width": 96, "height": 72, "empty_frames": 0}


@pytest.mark.parametrize("observation", ["pixels", "blobs", "centroids"])
def test_gymnasiums_checker_is_content(observation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, observation=observation, horizon=10).unwrapped)


@pytest.mark.parametrize("observation", ["blobs", "centroids"])
def test_stable_baselines3s_checker_is_content_through_flat_sets(observation):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(FlatSets(gym.make(ENV_ID, observation=observation, horizon=10, **SMALL)))


@pytest.fixture
def short_warm_up(monkeypatch):
    """Start scenes with fewer people, which makes every reset faster."""
    monkeypatch.setattr(scripts, "WARM_UP", 4.0)


def test_vector_environment_keeps_the_rules(short_warm_up):
    check_vector_env(ENV_ID, level=5, observation="blobs", horizon=9, max_episode_steps=4, steps=9, **SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [{"horizon": 2}, {"observation": "blobs", "level": 5, "horizon": 3}])
def test_vector_environment_is_the_single_one_in_all_modes(axes, short_warm_up):
    check_vector_matches_single(ENV_ID, **SMALL, **axes)


def test_vector_environment_is_the_single_one_to_the_bit(short_warm_up):
    axes = {"observation": "blobs", "level": 5, "horizon": 5, **SMALL}
    vector = gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", autoreset_mode="SameStep", **axes)
    singles = [gym.make(ENV_ID, **axes).unwrapped for _ in range(2)]
    seen, _ = vector.reset(seed=7)
    for row, env in enumerate(singles):
        assert np.array_equal(seen[row], env.reset(seed=7 + row)[0])
    rng = np.random.default_rng(0)
    for step in range(7):
        actions = rng.uniform(0.0, 1.0, vector.action_space.shape) * vector.action_space.high
        seen, rewards, _, truncated, infos = vector.step(actions)
        for row, env in enumerate(singles):
            observation, reward, _, over, info = env.step(actions[row])
            assert reward == rewards[row]
            assert over == truncated[row] == (step == 4)
            if over:
                assert info["hota"] == infos["final_info"]["hota"][row]
                assert np.array_equal(observation, infos["final_obs"][row])
                observation, info = env.reset()
            assert np.array_equal(observation, seen[row])
            assert np.array_equal(info["truth"]["boxes"], infos["truth"]["boxes"][row])


@pytest.mark.parametrize(("level", "observation"), [(0, "blobs"), (2, "centroids"), (4, "pixels"), (5, "blobs")])
def test_observations_lie_in_their_space(level, observation):
    env = gym.make(ENV_ID, level=level, observation=observation, horizon=12, **SMALL)
    seen, _ = env.reset(seed=level)
    truncated = False
    while not truncated:
        assert seen in env.observation_space
        seen, _, _, truncated, _ = env.step(env.action_space.sample())
    assert seen in env.observation_space


def test_agents_do_not_influence_the_frames():
    first, second = (gym.make(ENV_ID, level=4, **SMALL).unwrapped for _ in range(2))
    rng = np.random.default_rng(0)
    a, _ = first.reset(seed=4)
    b, _ = second.reset(seed=4)
    for _ in range(8):
        assert np.array_equal(a, b)
        a, *_ = first.step(np.zeros(first.action_space.shape))
        b, *_ = second.step(rng.uniform(0, 1, second.action_space.shape))


def test_detections_are_the_same_people_whatever_is_observed():
    blobs = gym.make(ENV_ID, observation="blobs", empty_frames=0)
    centroids = gym.make(ENV_ID, observation="centroids", empty_frames=0)
    boxes, _ = blobs.reset(seed=1)
    points, _ = centroids.reset(seed=1)
    assert boxes[:, 0].sum() == points[:, 0].sum() > 0
    for box, point in zip(boxes[boxes[:, 0] > 0, 1:], points[points[:, 0] > 0, 1:], strict=True):
        assert (box[:2] <= point).all()
        assert (point <= box[:2] + box[2:]).all()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_its_own_way_from_where_it_was_made(duplicate):
    env = gym.make(ENV_ID, observation="blobs", horizon=20, **SMALL).unwrapped
    env.reset(seed=2)
    silent = np.zeros(env.action_space.shape)
    env.step(silent)
    twin = duplicate(env)
    loud = silent + 0.6
    there = [env.step(silent) for _ in range(3)]
    here = [twin.step(loud) for _ in range(3)]
    for a, b in zip(there, here, strict=True):
        assert np.array_equal(a[0], b[0])
        assert a[1] != b[1]


def test_returned_arrays_are_the_callers_own():
    env = gym.make(ENV_ID, **SMALL).unwrapped
    first, info = env.reset(seed=0)
    kept, boxes = first.copy(), info["truth"]["boxes"].copy()
    second, *_ = env.step(np.zeros(env.action_space.shape))
    assert np.array_equal(first, kept)
    assert np.array_equal(info["truth"]["boxes"], boxes)
    second[:] = 0
    env.step(np.zeros(env.action_space.shape))
    again, _ = env.reset(seed=0)
    assert np.array_equal(again, kept)


def test_privileged_observation_puts_the_truth_beside_the_frame():
    env = PrivilegedObservation(gym.make(ENV_ID, **SMALL))
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert np.array_equal(observation["true_boxes"], info["truth"]["boxes"])
    assert np.array_equal(observation["true_existence"], info["truth"]["exists"])
    assert np.array_equal(observation["true_ids"], info["truth"]["ids"])


def test_scene_model():
    env = gym.make(ENV_ID, observation="centroids", empty_frames=7, max_people=9)
    scene = env.unwrapped.scene_model
    assert (scene.observation, scene.width, scene.height, scene.frame_rate) == ("centroids", 384, 288, 25.0)
    assert (scene.max_people, scene.empty_frames, scene.cutoff, scene.answers_boxes) == (9, 7, 40.0, False)
    paper = gym.make(ENV_ID, script="meet_split_third_guy").unwrapped
    assert (paper.scene_model.empty_frames, paper.scene_model.cutoff, paper.config.horizon) == (49, 1.0, 922)


@pytest.mark.parametrize("observation", ["pixels", "centroids"])
def test_pictures_show_answers_and_change_nothing(observation):
    env = gym.make(ENV_ID, observation=observation, render_mode="rgb_array").unwrapped
    blind = gym.make(ENV_ID, observation=observation).unwrapped
    env.reset(seed=0)
    blind.reset(seed=0)
    answer = np.zeros(env.action_space.shape)
    env.step(answer)
    blind.step(answer)
    empty = env.render()
    answer[3] = [0.9, 100.0, 150.0, 30.0, 70.0][: answer.shape[1]]
    env.reset(seed=0)
    assert env.render().shape == empty.shape
    env.step(answer)
    assert (env.render() != empty).any(axis=2).sum() > 100
    for _ in range(3):
        assert np.array_equal(env.step(answer)[0], blind.step(answer)[0])
    assert blind.render() is None


def test_the_picture_shows_the_frame_that_was_answered():
    env = gym.make(ENV_ID, render_mode="rgb_array", horizon=3, empty_frames=0).unwrapped
    frames = [env.reset(seed=5)[0]]
    silent = np.zeros(env.action_space.shape)
    for _ in range(3):
        frames.append(env.step(silent)[0])
        picture = env.render()
        height, width = (2 * side for side in frames[0].shape[:2])
        at = picture[16 : 16 + height, 16 : 16 + width].reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
        errors = [float(np.abs(at - frame).mean()) for frame in frames]
        assert int(np.argmin(errors)) == len(frames) - 2


def test_pictures_show_the_truth_on_request_only():
    pictures = []
    for show_truth in (False, True):
        env = gym.make(ENV_ID, render_mode="rgb_array", horizon=3, empty_frames=0, show_truth=show_truth).unwrapped
        _, info = env.reset(seed=5)
        env.step(np.zeros(env.action_space.shape))
        pictures.append(env.render())
    left, top, _, _ = info["truth"]["boxes"][np.flatnonzero(info["truth"]["exists"])[0]]
    changed = np.argwhere((pictures[0] != pictures[1]).any(axis=2))
    assert len(changed) > 50
    # The picture is the frame at twice its size, 16 px from the border.
    edge = np.abs(changed - (16 + 2.0 * np.array([top, left]))).max(axis=1)
    assert edge.min() <= 4
