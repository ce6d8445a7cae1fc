"""The clutter environment: statistics follow its arguments, and scores agree with values computed by hand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats

import servotrack  # noqa: F401
from servotrack.envs.track.clutter.config import LEVEL_NAMES, clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.envs.track.counts import poisson_quantile
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.metrics import ospa2, stack_tracks
from servotrack.estimators.rfs.models import STRUCTURES

LEVELS = range(len(LEVEL_NAMES))
ENV_ID = "ClutterTracking-v0"


def position(states):
    return states[..., [0, 2]]


def true_answer(env, info):
    """Return the ground truth as an answer, with target i in row i."""
    answer = np.zeros(env.action_space.shape)
    truth = info["truth"]
    answer[: len(truth["exists"]), 0] = truth["exists"]
    answer[: len(truth["exists"]), 1:] = position(truth["states"])
    return answer


@pytest.fixture(scope="module")
def many():
    return [draw_episode(clutter_config(0), seed) for seed in range(40)]


def test_papers_targets_are_born_and_die_when_the_paper_says(many):
    exists = many[0].exists
    assert exists[:, :3].all(axis=1)[:70].all()
    assert not exists[70:, :2].any()
    assert exists[70:, 2].all()
    for target, first in zip(range(3, 12), (20, 20, 20, 40, 40, 60, 60, 80, 80), strict=True):
        assert not exists[: first - 1, target].any()
        assert exists[first - 1 :, target].all()
    assert many[0].states[0, 1].tolist() == [400.0, -10.0, -600.0, 5.0]


def test_truth_stays_inside_and_is_drawn_anew(many):
    assert all(np.abs(position(episode.states)).max() <= 2000.0 for episode in many)
    assert not np.array_equal(many[0].states, many[1].states)


def test_detections_and_clutter_are_as_frequent_as_configured(many):
    targets = sum(int(episode.exists.sum()) for episode in many)
    detected = sum(int((episode.source >= 0).sum()) for episode in many)
    assert detected / targets == pytest.approx(0.98, abs=4 * np.sqrt(0.98 * 0.02 / targets))
    clutter = np.array([(episode.source == -1).sum(axis=1) for episode in many]).ravel()
    assert clutter.mean() == pytest.approx(20.0, abs=4 * np.sqrt(20.0 / clutter.size))
    assert clutter.var() == pytest.approx(20.0, rel=0.1)
    places = np.concatenate([episode.measurements[episode.source == -1][:, 1:] for episode in many])
    assert stats.kstest((places[:, 0] + 2000.0) / 4000.0, "uniform").pvalue > 1e-3
    assert stats.kstest((places[:, 1] + 2000.0) / 4000.0, "uniform").pvalue > 1e-3


def test_measurements_are_of_their_targets_once_each_and_rows_are_shuffled(many):
    errors, firsts = [], []
    for episode in many:
        for scan in range(len(episode.states)):
            rows = np.flatnonzero(episode.source[scan] >= 0)
            targets = episode.source[scan, rows]
            assert len(set(targets.tolist())) == len(targets)
            errors.append(episode.measurements[scan, rows, 1:] - position(episode.states[scan, targets]))
            firsts.append(episode.source[scan, 0] >= 0)
            used = episode.measurements[scan, :, 0]
            assert np.array_equal(used, (episode.source[scan] > -2).astype(float))
            assert not episode.measurements[scan, used == 0.0].any()
    spread = np.concatenate(errors)
    assert spread.std(axis=0) == pytest.approx([1.5, 1.5], rel=0.02)
    assert 0.1 < np.mean(firsts) < 0.5


@pytest.mark.parametrize("structure", ["HMM", *STRUCTURES])
def test_local_moments_are_the_hidden_markov_models(structure):
    noisy = 10.0 if structure in ("S4", "S5") else 1.5
    config = clutter_config(
        1, structure=structure, position_noise=noisy, half_width=1e6, max_targets=100, initial_targets=100.0,
        birth_rate=0.0, survival_probability=1.0, horizon=60, detection_probability=1.0, clutter_rate=0.0,
    )  # fmt: skip
    episode = draw_episode(config, 3)
    n = int(episode.exists[0].sum())
    x = episode.states[:, :n]
    order = np.argsort(episode.source[:, :n], axis=1)
    y = np.take_along_axis(episode.measurements[:, :n, 1:], order[..., None], axis=1)
    linear = scene_model_of(config).hidden_markov
    step = (x[1:] - x[:-1] @ linear.transition.T).reshape(-1, 4)
    error = (y - position(x)).reshape(-1, 2)
    count = len(step)
    Q, R = linear.process_noise, linear.measurement_noise
    assert np.abs(step.mean(axis=0)).max() < 5 * np.sqrt(Q.max() / count)
    # Standard errors of a covariance's entries, doubled because successive samples depend on each other.
    assert np.allclose(np.cov(step.T), Q, atol=10 * Q.max() / np.sqrt(count))
    assert np.allclose(np.cov(error.T), R, atol=10 * R.max() / np.sqrt(count))
    cross = (step[:, :, None] * error.reshape(60 + 1, n, 2)[1:].reshape(-1, 1, 2)).mean(axis=0)
    bound = 10 * np.sqrt(Q.max() * R.max() / count)
    assert np.abs(cross).max() < bound


def test_each_quantity_has_a_stream_of_its_own():
    base = draw_episode(clutter_config(0), 5)
    fewer = draw_episode(clutter_config(0, detection_probability=0.5), 5)
    louder = draw_episode(clutter_config(0, clutter_rate=40.0), 5)
    assert np.array_equal(base.states, fewer.states)
    assert np.array_equal(base.states, louder.states)
    seen = set(map(tuple, fewer.measurements[10, fewer.source[10] >= 0, 1:]))
    assert seen <= set(map(tuple, base.measurements[10, base.source[10] >= 0, 1:]))
    turning = draw_episode(clutter_config(1, maneuver_rate=0.0), 5)
    straight = draw_episode(clutter_config(1, maneuver_rate=0.2, max_turn_rate=0.0), 5)
    assert np.array_equal(turning.states, straight.states)


def test_range_and_bearing_are_the_positions():
    config = clutter_config(4)
    episode = draw_episode(config, 0)
    scan = 20
    rows = np.flatnonzero(episode.source[scan] >= 0)
    x, y = position(episode.states[scan, episode.source[scan, rows]]).T
    sensor_x, sensor_y = config.sensor_position
    distance, bearing = episode.measurements[scan, rows, 1:].T
    assert np.abs(distance - np.hypot(x - sensor_x, y - sensor_y)).max() < 6 * config.range_noise
    assert np.abs(bearing - np.arctan2(y - sensor_y, x - sensor_x)).max() < 6 * config.bearing_noise


def test_targets_turn_on_the_maneuvering_level():
    config = clutter_config(1, maneuver_rate=1.0, max_turn_rate=0.3, acceleration_noise=0.5, position_noise=0.1)
    episode = draw_episode(config, 0)
    v = episode.states[..., [1, 3]]
    alive = episode.exists[1:] & episode.exists[:-1]
    before, after = v[:-1][alive], v[1:][alive]
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    fast = np.hypot(*before.T) > 10.0
    assert np.abs(turn[fast]).max() < 0.3 + 0.25
    assert turn[fast].std() == pytest.approx(0.3 / np.sqrt(3.0), rel=0.15)


def test_overflow_drops_clutter_only():
    config = clutter_config(0, clutter_rate=60.0, max_measurements=20, detection_probability=1.0)
    episode = draw_episode(config, 0)
    assert episode.measurements.shape[1] == 20
    for scan in range(100):
        assert (episode.source[scan] >= 0).sum() == episode.exists[scan].sum()
        assert (episode.source[scan] == -1).sum() == 20 - episode.exists[scan].sum()


@pytest.mark.parametrize("rate", [0.0, 0.1, 1.0, 7.3, 20.0, 60.0, 500.0])
def test_rows_suffice_for_all_but_a_billionth_of_the_scans(rate):
    quantile = poisson_quantile(rate)
    assert stats.poisson.sf(quantile, rate) < 1e-9 if rate else quantile == 0
    assert quantile <= stats.poisson.isf(1e-9, rate) + 1


def test_a_hundred_targets_fit():
    config = clutter_config(1, max_targets=100, initial_targets=100.0, birth_rate=5.0, survival_probability=1.0)
    assert draw_episode(config, 0).exists.sum(axis=1).max() > 80


def test_truth_scores_zero_and_silence_scores_all_missed():
    env = gym.make(ENV_ID).unwrapped
    _, info = env.reset(seed=1)
    for _ in range(100):
        present = int(info["truth"]["exists"].sum())
        assert info["ospa"] == 0.0
        _, reward, terminated, truncated, info = env.step(true_answer(env, info))
        assert reward == 0.0
        assert info["cardinality_error"] == 0
        assert not terminated
    assert truncated
    assert info["ospa2"] == 0.0
    _, info = env.reset(seed=1)
    present = int(info["truth"]["exists"].sum())
    _, reward, *_, info = env.step(np.zeros(env.action_space.shape))
    assert reward == -present / 2
    assert info["missed_error"] == 50.0 * present
    assert info["cardinality_error"] == -present
    assert info["ospa"] == 100.0


def test_a_located_target_costs_its_error_and_a_false_one_a_half():
    env = gym.make(ENV_ID).unwrapped
    _, info = env.reset(seed=2)
    answer = true_answer(env, info)
    answer[0, 1] += 30.0
    answer[20] = [0.6, 1900.0, 1900.0]
    _, reward, *_, info = env.step(answer)
    assert reward == pytest.approx(-0.3 - 0.5)
    assert (info["location_error"], info["false_error"], info["missed_error"]) == pytest.approx((30.0, 50.0, 0.0))


def test_swapped_identities_cost_ospa2_and_nothing_else():
    env = gym.make(ENV_ID).unwrapped
    _, info = env.reset(seed=1)
    total = 0.0
    for step in range(100):
        answer = true_answer(env, info)
        if step >= 50:
            answer[[2, 3]] = answer[[3, 2]]
        _, reward, _, _, info = env.step(answer)
        total += reward
    assert total == 0.0
    assert info["ospa2"] > 5.0


def test_rows_are_identities():
    scorer = SetScorer(1, 3, 2, horizon=10, cutoff=100.0)
    nothing = np.zeros((1, 0, 2)), np.zeros((1, 0), bool)

    def labels(existence, step):
        answers = np.zeros((1, 3, 3))
        answers[0, :, 0] = existence
        scorer.score(answers, *nothing, [step])
        return scorer.labels[0].tolist(), scorer.reported[0].tolist()

    assert labels([0.9, 0.1, 0.0], 0) == ([0, 1, -1], [True, False, False])
    assert labels([0.3, 0.5, 0.0], 1) == ([0, 1, -1], [False, True, False])
    assert labels([0.04, 0.05, 1.0], 2) == ([-1, 1, 2], [False, False, True])
    assert labels([0.9, 0.0, 1.0], 3) == ([3, -1, 2], [True, False, True])


def test_the_score_of_an_episode_is_ospa2_of_its_tracks():
    rng, scorer = np.random.default_rng(5), SetScorer(1, 6, 2, horizon=12, cutoff=100.0)
    truth = rng.uniform(0.0, 200.0, (3, 12, 2))
    truth[1, :4] = truth[2, 7:] = np.nan
    for step in range(12):
        answers = np.concatenate([rng.uniform(0.0, 1.0, (1, 6, 1)), rng.uniform(0.0, 200.0, (1, 6, 2))], axis=2)
        scorer.score(answers, np.zeros((1, 0, 2)), np.zeros((1, 0), bool), [step])
    tracks = scorer.tracks(0)
    # Some identities were held without being reported.
    assert 3 < len(tracks) <= scorer.labels.max()
    assert scorer.trajectory_score(0, truth) == ospa2(truth, stack_tracks(tracks, 12, 2), 100.0)


def test_agents_do_not_influence_the_scans():
    first, second = gym.make(ENV_ID).unwrapped, gym.make(ENV_ID).unwrapped
    rng = np.random.default_rng(0)
    a, _ = first.reset(seed=4)
    b, _ = second.reset(seed=4)
    for _ in range(10):
        assert np.array_equal(a, b)
        a, *_ = first.step(np.zeros(first.action_space.shape))
        b, *_ = second.step(rng.uniform(0, 1, second.action_space.shape))


def test_scene_model_is_wrong_only_on_mismatched_levels():
    for level in range(5):
        config = clutter_config(level)
        scene = scene_model_of(config)
        assert scene.detection_probability == config.detection_probability
        assert scene.clutter_rate == config.clutter_rate
    assert scene_model_of(clutter_config(5)).detection_probability == 0.98 != clutter_config(5).detection_probability
    assert scene_model_of(clutter_config(6)).clutter_rate == 5.0 != clutter_config(6).clutter_rate
    assert scene_model_of(clutter_config(7)).birth_means is not None
    assert scene_model_of(clutter_config(7, told_births=None)).birth_means is None


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"level": 8}, "level must be a whole number from 0 to 7"),
        ({"detection_probability": 1.1}, r"detection_probability must lie in \[0, 1\], got 1.1"),
        ({"clutter_rate": float("nan")}, "clutter_rate must lie in"),
        ({"max_targets": 5}, "max_targets must be at least 12"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"scenario": "sea"}, "scenario must be one of paper, random"),
        ({"max_measurements": 3}, "max_measurements must be at least max_targets"),
        ({"sensor": "range-bearing"}, "structure must be 'HMM'"),
        ({"acceleration_noise": 1.0}, "F2 and H2 must keep"),
        ({"render_mode": "text"}, "render_mode must be None or one of"),
    ],
)
def test_bad_arguments_are_named(keywords, match):
    with pytest.raises(ValueError, match=match):
        gym.make(ENV_ID, **keywords)


def test_unknown_keyword_suggests_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'clutter_rate'"):
        clutter_config(0, cluter_rate=3.0)


def test_impossible_region_says_what_to_do():
    env = gym.make(ENV_ID, half_width=700.0, acceleration_noise=50.0)
    with pytest.raises(ValueError, match="widen half_width"):
        env.reset(seed=0)


def test_bad_answers_are_named():
    env = gym.make(ENV_ID).unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(env.action_space.shape))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must have shape"):
        env.step(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(np.full(env.action_space.shape, np.nan))
    with pytest.raises(ValueError, match="reset options"):
        env.reset(options={"x": 1})


@pytest.mark.parametrize("level", LEVELS)
def test_observations_lie_in_their_space(level):
    env = gym.make(ENV_ID, level=level, horizon=30)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert observation in env.observation_space
        truncated = False
        while not truncated:
            observation, _, _, truncated, _ = env.step(env.action_space.sample())
            assert observation in env.observation_space


@pytest.mark.parametrize("level", [0, 2, 3, 4])
def test_a_lag_changes_no_scan_and_appends_others(level):
    without = draw_episode(clutter_config(level), 3)
    late = draw_episode(clutter_config(level, lag=8), 3)
    scans = len(without.states)
    assert len(late.states) == scans + 8
    for name in ("states", "exists", "measurements", "source"):
        np.testing.assert_array_equal(getattr(late, name)[:scans], getattr(without, name))
    assert not (late.exists[scans:] & ~without.exists[-1]).any()
    if level == 0:
        assert (late.exists[-1] == late.exists[scans - 1]).mean() > 0.8
    both = late.exists[scans - 1 : -1] & late.exists[scans:]
    moved = np.linalg.norm(np.diff(position(late.states[scans - 1 :]), axis=0), axis=-1)[both]
    assert both.any() and moved.max() < 200.0


def test_answers_are_late_by_the_lag():
    env = gym.make(ENV_ID, level=1, horizon=20, lag=3).unwrapped
    _, info = env.reset(seed=1)
    answers, scored, rewards, truncated = [], [], [], False
    while not truncated:
        answers.append(true_answer(env, info))
        late = answers[-4] if len(answers) > 3 else np.zeros(env.action_space.shape)
        _, reward, _, truncated, info = env.step(late)
        scored.append(info["scored"])
        rewards.append(reward)
    assert scored == [False] * 3 + [True] * 20
    assert max(map(abs, rewards)) == 0.0
    assert info["ospa2"] == 0.0 and info["episode_scored"]
