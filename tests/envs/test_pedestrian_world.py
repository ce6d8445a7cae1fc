"""Scores of the pedestrian environment agree with hand values; occluded people are neither missed nor false."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.track.ignored import ignored_answers
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.detect import BlobFinder, MaskedBackground
from servotrack.estimators.metrics import box_distances, mot_scores, ospa2, point_distances

ENV_ID = "PedestrianTracking-v0"


def true_answer(env, info):
    """Return the ground truth as an answer, one row per identity; occluded people are held without being reported."""
    truth, answer = info["truth"], np.zeros(env.action_space.shape)
    boxes, n = truth["boxes"], len(truth["ids"])
    answer[:n, 0] = np.where(truth["exists"], 1.0, np.where(truth["ids"] > 0, 0.2, 0.0))
    answer[:n, 1:] = boxes if answer.shape[1] == 5 else boxes[:, :2] + boxes[:, 2:] / 2.0
    return answer


@pytest.mark.parametrize(("observation", "level"), [("pixels", 2), ("centroids", 1)])
def test_truth_scores_zero(observation, level):
    env = gym.make(ENV_ID, level=level, observation=observation, horizon=60, empty_frames=0).unwrapped
    _, info = env.reset(seed=3)
    truncated = False
    while not truncated:
        _, reward, terminated, truncated, info = env.step(true_answer(env, info))
        assert reward == pytest.approx(0.0, abs=1e-12)
        assert info["cardinality_error"] == 0
        assert not terminated
    assert info["ospa2"] == pytest.approx(0.0, abs=1e-12)
    assert (info["mota"], info["idf1"], info["hota"]) == pytest.approx((1.0, 1.0, 1.0))


def test_an_empty_answer_to_an_empty_scene_has_no_error():
    env = gym.make(ENV_ID, people=0.0, horizon=3).unwrapped
    env.reset(seed=0)
    for _ in range(3):
        _, reward, *_, info = env.step(np.zeros(env.action_space.shape))
        assert reward == 0.0
    assert [info[name] for name in ("ospa2", "mota", "idf1", "hota")] == [0.0, 1.0, 1.0, 1.0]


def test_silence_scores_all_missed_and_a_false_box_a_half():
    env = gym.make(ENV_ID, empty_frames=0).unwrapped
    _, info = env.reset(seed=1)
    present = int(info["truth"]["exists"].sum())
    assert present > 0
    answer = np.zeros(env.action_space.shape)
    _, reward, *_, info = env.step(answer)
    assert reward == -present / 2
    assert info["missed_error"] == present / 2
    assert info["ospa"] == 1.0
    answer = true_answer(env, info)
    there = int(info["truth"]["exists"].sum())
    # In the corner above the floor, where nobody can be.
    answer[-1] = [0.6, 0.0, 0.0, 8.0, 8.0]
    _, reward, *_, info = env.step(answer)
    assert reward == -0.5
    assert (info["missed_error"], info["false_error"], info["cardinality_error"]) == (0.0, 0.5, 1)
    assert info["ospa"] == pytest.approx(1.0 / (there + 1))


def test_a_shifted_box_costs_one_minus_its_overlap_and_a_shifted_point_its_way():
    env = gym.make(ENV_ID, script="crossing", empty_frames=0).unwrapped
    _, info = env.reset(seed=0)
    answer = true_answer(env, info)
    row = int(np.argmax(info["truth"]["exists"]))
    answer[row, 1] += 0.25 * answer[row, 3]
    _, reward, *_ = env.step(answer)
    assert reward == pytest.approx(-(1.0 - 0.75 / 1.25))
    env = gym.make(ENV_ID, script="crossing", observation="centroids", empty_frames=0).unwrapped
    _, info = env.reset(seed=0)
    answer = true_answer(env, info)
    answer[row, 2] += 10.0
    _, reward, *_, info = env.step(answer)
    assert reward == pytest.approx(-0.25)
    assert info["location_error"] == pytest.approx(10.0)


def test_swapped_identities_cost_the_episodes_scores_only():
    env = gym.make(ENV_ID, script="meet_split_third_guy", horizon=300).unwrapped
    _, info = env.reset(seed=0)
    for step in range(300):
        answer = true_answer(env, info)
        if step >= 240:
            answer[[0, 1]] = answer[[1, 0]]
        _, reward, *_, info = env.step(answer)
        assert reward == 0.0
    assert info["ospa2"] > 0.2
    assert info["idf1"] < 0.85
    assert 0.98 < info["mota"] < 1.0


def test_number_of_counted_people_is_the_papers():
    env = gym.make(ENV_ID, script="meet_split_third_guy", horizon=330).unwrapped
    _, info = env.reset(seed=1)
    silent, numbers = np.zeros(env.action_space.shape), []
    for _ in range(330):
        numbers.append(int(info["truth"]["exists"].sum()))
        *_, info = env.step(silent)
    assert numbers == [0] * 49 + [1] * 120 + [2] * 150 + [3] * 11


def test_truth_is_what_the_picture_shows():
    env = gym.make(ENV_ID, level=2, sensor_noise=0.0, empty_frames=0).unwrapped
    frame, info = env.reset(seed=2)
    truth = info["truth"]
    there = truth["ids"] > 0
    assert len(set(truth["ids"][there].tolist())) == there.sum() > 3
    assert ((truth["visibility"] >= 0.2) & there == truth["exists"]).all()
    left, top, width, height = truth["boxes"][there].T
    assert (left >= 0).all()
    assert (left + width <= frame.shape[1]).all()
    assert (top + height <= frame.shape[0]).all()
    assert (width > 0).all()
    assert (height > 0).all()
    assert not truth["boxes"][~there].any()
    assert not truth["visibility"][~there].any()


def test_blobs_are_where_people_are():
    env = gym.make(ENV_ID, observation="blobs", camouflage=0.0, empty_frames=0).unwrapped
    found, info = env.reset(seed=1)
    overlaps = []
    for _ in range(40):
        truth, seen = info["truth"], found[found[:, 0] > 0, 1:]
        visible = truth["visibility"] > 0.9
        if visible.any():
            assert len(seen)
            overlaps.extend(1.0 - box_distances(truth["boxes"][visible], seen).min(axis=1))
        found, *_, info = env.step(np.zeros(env.action_space.shape))
    assert np.median(overlaps) > 0.6


def test_regions_of_a_plain_detector_fall_apart_and_merge_as_on_real_video():
    """Blob statistics lie in the ranges of real recordings with camouflage and groups."""
    detector = MaskedBackground(faint=0.0, blobs=BlobFinder(split=False))
    regions_of, merged = [], []
    for seed in range(4):
        env = gym.make(ENV_ID, horizon=160)
        image, info = env.reset(seed=seed)
        state = detector.initial(image)
        for frame in range(160):
            state, found = detector.step(state, image)
            boxes = info["truth"]["boxes"][info["truth"]["exists"]]
            if frame >= 30 and frame % 3 == 0 and len(boxes):
                within = contained(found.centroids, boxes)
                regions_of.extend(within.sum(axis=0))
                merged.append((contained(boxes[:, :2] + boxes[:, 2:] / 2.0, found.boxes).sum(axis=0) >= 2).sum())
            image, *_, info = env.step(np.zeros(env.action_space.shape))
    shares = np.bincount(np.minimum(regions_of, 2), minlength=3) / len(regions_of)
    assert 0.02 <= shares[0] <= 0.25
    assert 0.26 <= shares[1] <= 0.86
    assert 0.02 <= shares[2] <= 0.49
    assert 0.0 < np.mean(merged) <= 0.8


def contained(points, boxes):
    """Return a mask of the points inside boxes, shape (points, boxes)."""
    low, high = boxes[None, :, :2], boxes[None, :, :2] + boxes[None, :, 2:]
    return ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=-1)


def scored(scorer, existence, states, truth, counted, hidden, step=0):
    answers = np.concatenate([np.array(existence)[:, None], np.array(states)], axis=1)[None]
    return scorer.score(answers, np.array(truth)[None], np.array([counted]), [step], np.array([hidden]))


def test_hidden_members_are_neither_missed_nor_false():
    truth = [[0.0, 0.0], [100.0, 0.0]]
    scorer = SetScorer(1, 3, 2, horizon=4, cutoff=40.0)
    silent = scored(scorer, [0, 0, 0], np.zeros((3, 2)), truth, [True, False], [False, True])
    assert (silent.gospa.missed[0], silent.gospa.false[0], silent.cardinality_error[0]) == (20.0, 0.0, -1)
    at_both = [[0.0, 0.0], [110.0, 0.0], [0.0, 0.0]]
    good = scored(scorer, [1, 1, 0], at_both, truth, [True, False], [False, True], step=1)
    assert (good.gospa.total[0], good.ospa[0], good.cardinality_error[0]) == (0.0, 0.0, 0)
    assert scorer.reported[0].tolist() == [True, True, False]  # pictures show it all the same
    assert [track.steps.tolist() for track in scorer.tracks(0)] == [[1]]
    far = [[0.0, 0.0], [125.0, 0.0], [0.0, 0.0]]
    bad = scored(scorer, [1, 1, 0], far, truth, [True, False], [False, True], step=2)
    assert (bad.gospa.false[0], bad.cardinality_error[0]) == (20.0, 1)
    twice = [[0.0, 0.0], [100.0, 0.0], [101.0, 0.0]]
    one_of_two = scored(scorer, [1, 1, 1], twice, truth, [True, False], [False, True], step=3)
    assert (one_of_two.gospa.false[0], one_of_two.cardinality_error[0]) == (20.0, 1)


def test_scored_targets_come_first():
    # One answer between somebody who counts and, nearer, somebody hidden: it locates the one who counts.
    scorer = SetScorer(1, 1, 2, horizon=1, cutoff=40.0)
    found = scored(scorer, [1], [[12.0, 0.0]], [[0.0, 0.0], [14.0, 0.0]], [True, False], [False, True])
    assert (found.gospa.location[0], found.gospa.missed[0], found.gospa.false[0]) == (12.0, 0.0, 0.0)


def test_ignored_answers_are_decided_scene_by_scene():
    distances = np.full((2, 2, 2), 1.0)
    distances[0, 1, 1] = distances[1, 0, 0] = 0.2
    counted = np.array([[True, False], [False, True]])
    reported = np.array([[True, True], [True, False]])
    hidden = np.array([[False, True], [False, False]])
    assert ignored_answers(distances, counted, hidden, reported, 1.0).tolist() == [[False, True], [False, False]]


def test_scorer_without_hidden_members_is_as_before():
    rng = np.random.default_rng(0)
    answers, truth = rng.uniform(0, 100, (2, 5, 3)), rng.uniform(0, 100, (2, 4, 2))
    answers[..., 0] = rng.random((2, 5))
    there = rng.random((2, 4)) < 0.7
    plain, masked = (SetScorer(2, 5, 2, horizon=1, cutoff=40.0, distances=point_distances) for _ in range(2))
    a = plain.score(answers, truth, there, [0, 0])
    b = masked.score(answers, truth, there, [0, 0], np.zeros_like(there))
    assert np.array_equal(a.ospa, b.ospa)
    assert np.array_equal(a.gospa.total, b.gospa.total)


def test_episode_scores_are_those_of_the_tracks():
    env = gym.make(ENV_ID, script="crossing", horizon=40, people=6.0, empty_frames=0).unwrapped
    _, info = env.reset(seed=0)
    rng, truncated = np.random.default_rng(1), False
    while not truncated:
        answer = true_answer(env, info)
        answer[:, 1:] += rng.normal(0.0, 2.0, answer[:, 1:].shape)
        answer[:, 0] *= rng.random(len(answer)) > 0.1
        *_, truncated, info = env.step(answer)
    true, answered = env.world.true_tracks(0), env.world.answered_tracks(0)
    found = mot_scores(true, answered)
    assert (info["mota"], info["idf1"], info["hota"]) == pytest.approx((found.mota, found.idf1, found.hota))
    assert 0.3 < info["hota"] < 0.95
    assert sum(len(track.steps) for track in true) > 100


def test_ospa2_of_boxes_uses_their_distance():
    a, b = np.full((1, 4, 4), np.nan), np.full((1, 4, 4), np.nan)
    a[0, :3] = [0.0, 0.0, 10.0, 10.0]
    b[0, 1:] = [5.0, 0.0, 10.0, 10.0]
    third = 1.0 - 50.0 / 150.0
    assert ospa2(a, b, 1.0, distances=box_distances) == pytest.approx((2 * third + 2 * 1.0) / 4)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 50, (3, 9, 2)), rng.uniform(0, 50, (4, 9, 2))
    x[0, 4:], y[2, :5] = np.nan, np.nan
    assert ospa2(x, y, 20.0, distances=point_distances) == pytest.approx(ospa2(x, y, 20.0))


def test_bad_answers_are_named():
    env = gym.make(ENV_ID, width=96, height=72, empty_frames=0).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(env.action_space.shape))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must have shape"):
        env.step(np.zeros((3, 5)))
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(np.full(env.action_space.shape, np.nan))
    with pytest.raises(ValueError, match="reset options"):
        env.reset(options={"x": 1})
