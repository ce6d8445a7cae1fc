"""Published scenarios of the clutter environment: their facts, and every agent's scene model."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.baselines import evaluate
from servotrack.baselines.leaderboard.clutter_bound import ospa_bound
from servotrack.baselines.leaderboard.meyer_scene import MEYER_FILTERS, meyer_scene, tracked
from servotrack.baselines.leaderboard.published_scenarios import (
    METRICS,
    MEYER,
    circular_error_probability,
    play,
    score,
    sources,
    table,
)
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scenarios import SCENARIOS
from servotrack.envs.track.clutter.scene_model import scene_model_of

ENV_ID = "ClutterTracking-v0"
NEW = [name for name, one in SCENARIOS.items() if one.settings]


def positions(episode: Any) -> np.ndarray:
    return np.asarray(episode.states[..., [0, 2]])


@pytest.mark.parametrize("scenario", NEW)
def test_gymnasiums_checker_is_silent_and_keywords_override(scenario: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, scenario=scenario).unwrapped, skip_render_check=True)
    config = clutter_config(scenario=scenario, detection_probability=0.7, clutter_rate=3.0)
    assert config.detection_probability == 0.7 and config.clutter_rate == 3.0
    assert scene_model_of(config).detection_probability == 0.7
    assert config.cutoff == dict(SCENARIOS[scenario].settings).get("cutoff", 100.0)


def test_vo_and_ma_targets_cross_and_a_third_splits_off() -> None:
    config = clutter_config(scenario="vo-ma-2006")
    first, second = draw_episode(config, 1), draw_episode(config, 2)
    np.testing.assert_array_equal(first.states, second.states)
    assert (first.measurements != second.measurements).any()
    where = positions(first)
    assert np.linalg.norm(where[:, 0] - where[:, 1], axis=1)[:100].argmin() + 1 in (53, 54)
    assert first.exists[:100].sum(axis=0).tolist() == [100, 100, 35]
    np.testing.assert_allclose(where[65, 2], where[65, 0], atol=2.5)
    np.testing.assert_allclose(np.diff(where[:65, 0], axis=0), [[2.5, -12.0]] * 64, atol=1e-9)
    # Figure 1: ends of the paths; the third target turns away, and its velocity is that of its path.
    np.testing.assert_allclose(where[99], [[497.6, -937.8], [937.7, -497.6], [-150.2, -775.8]], atol=0.6)
    turning = first.states[65:100, 2]
    np.testing.assert_allclose(turning[1:, 0] - turning[:-1, 0], (turning[1:, 1] + turning[:-1, 1]) / 2)
    detected = first.measurements[65:100][first.source[65:100] == 2][:, 1:]
    assert np.abs(detected - turning[: len(detected), [0, 2]]).max() < 60.0
    scene = scene_model_of(config)
    assert scene.birth_means is not None and scene.birth_means[:, [0, 2]].tolist() == [[250.0] * 2, [-250.0] * 2]
    assert scene.birth_weights.tolist() == [0.1, 0.1] and scene.clutter_intensity == pytest.approx(12.5e-6)
    assert np.diag(scene.birth_covariance).tolist() == [100.0, 25.0] * 2
    (spawn,) = scene.spawn
    assert spawn.weight == 0.05 and np.diag(spawn.noise).tolist() == [100.0, 400.0] * 2


def test_the_pair_is_the_same_without_the_third_target() -> None:
    pair, three = (draw_episode(clutter_config(scenario=name), 1) for name in ("vo-ma-2006-pair", "vo-ma-2006"))
    np.testing.assert_array_equal(pair.states, three.states[:, :2])
    assert not scene_model_of(clutter_config(scenario="vo-ma-2006-pair")).spawn


def test_the_demo_has_the_numbers_of_its_code() -> None:
    exists = draw_episode(clutter_config(scenario="vo-demo"), 1).exists
    assert exists.sum(axis=1)[[0, 18, 19, 39, 59, 69, 70, 79, 99]].tolist() == [3, 3, 6, 8, 10, 10, 8, 10, 10]


def test_two_radars_see_five_targets_meet_in_the_middle() -> None:
    scene = meyer_scene(500_000)
    assert [len(scene.truth[k]) for k in (0, 3, 4, 24, 154, 155, 174, 175)] == [0, 0, 1, 5, 5, 4, 1, 0]
    assert np.abs(scene.truth[100]).max() < 250.0 < 500.0 < np.linalg.norm(scene.truth[30], axis=1).min()
    value, number = score(METRICS[MEYER], [tracked(scene, MEYER_FILTERS["pmb"])])
    assert value.value < 20.0 and number.value < 0.2


def test_williams_targets_meet_in_the_middle_and_move_as_the_model_says() -> None:
    config = clutter_config(scenario="williams-2015")
    many = [draw_episode(config, seed) for seed in range(40)]
    states = np.stack([episode.states[:201] for episode in many])
    assert all(episode.exists.all() for episode in many)
    assert np.abs(states[:, 100]).max() < 0.01
    # Forward and backward alike: a random walk of the velocity with variance 0.01 per scan.
    for step in (1, 50, 100):
        for side in (100 + step, 100 - step):
            assert states[:, side][..., [1, 3]].std() == pytest.approx(0.1 * np.sqrt(step), rel=0.1)
    F = config.motion.packed.transition[:4, :4]
    pushes = states[:, 1:] - np.einsum("rj,ektj->ektr", F, states[:, :-1])
    np.testing.assert_allclose(
        np.cov(pushes[..., :2].reshape(-1, 2).T), 0.01 * np.array([[1 / 3, 0.5], [0.5, 1.0]]), rtol=0.03
    )
    clutter = np.concatenate([episode.measurements[episode.source == -1, 1:] for episode in many])
    assert np.abs(clutter).max() <= 100.0 and scene_model_of(config).clutter_intensity == pytest.approx(10 / 200**2)


def test_one_of_four_targets_dies_where_they_are_close() -> None:
    config = clutter_config(scenario="garcia-fernandez-2018")
    many = [draw_episode(config, seed) for seed in range(60)]
    for episode in many:
        assert episode.exists[:81].sum(axis=0).tolist() == [40, 81, 81, 81]
    middle = np.stack([episode.states[40, 1:] for episode in many])
    assert middle.std() == pytest.approx(np.sqrt(0.1), rel=0.1)


def test_the_task_of_mt3_has_its_rates() -> None:
    config = clutter_config(scenario="pinto-2021")
    many = [draw_episode(config, seed) for seed in range(400)]
    first = np.array([episode.exists[0].sum() for episode in many])
    assert first.mean() == pytest.approx(6.0, abs=0.4)
    # In MT3 no target appears in the last two scans; its configuration gives the mean number in the last one.
    old = np.array([(episode.exists[19] & episode.exists[:18].any(axis=0)).sum() for episode in many])
    assert old.mean() == pytest.approx(5.335, abs=0.35)
    assert config.motion.packed.noise[1, 1] == pytest.approx(0.9 * 0.1)


@pytest.mark.parametrize("scenario", NEW)
def test_a_lag_changes_no_scan_and_goes_on_behind_the_last_one(scenario: str) -> None:
    plain, late = (draw_episode(clutter_config(scenario=scenario, lag=lag), 5) for lag in (0, 4))
    known = len(plain.exists)
    np.testing.assert_array_equal(late.measurements[:known], plain.measurements)
    assert len(late.exists) == known + 4
    if not clutter_config(scenario=scenario).draws_lives:
        assert late.exists[known:].sum() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "vo-ma-2007"}, "scenario must be one of paper, random, vo-ma-2006"),
        ({"scenario": "vo-ma-2006", "level": 2}, "level must be 0 with scenario='vo-ma-2006'"),
        ({"scenario": "williams-2015", "max_targets": 5}, "max_targets must be at least 6"),
        ({"scenario": "williams-2015", "structure": "S1"}, "structure must be 'HMM' and maneuver_rate 0"),
        ({"scenario": "williams-2015", "maneuver_rate": 0.1}, "structure must be 'HMM' and maneuver_rate 0"),
        ({"scenario": "vo-ma-2006", "half_width": 300.0}, "no path of 101 scans"),
    ],
)
def test_what_a_scenario_cannot_be_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(ENV_ID, **arguments).reset(seed=0)


def test_the_bound_refuses_paths_that_are_not_the_models() -> None:
    for scenario in ("vo-ma-2006", "williams-2015"):
        with pytest.raises(ValueError, match="the bound needs paths"):
            ospa_bound(clutter_config(scenario=scenario), 0)
    assert ospa_bound(clutter_config(scenario="pinto-2021"), 100_000) > 0.0


@pytest.mark.parametrize("agent", ["gm-phd", "gm-cbmember", "pmb", "pmbm", "robust-pmb"])
def test_filters_take_targets_that_split_off(agent: str) -> None:
    row = evaluate(ENV_ID, agent, [100_000], {"scenario": "vo-ma-2006", "clutter_rate": 1.0}, timing=False).rows[0]
    assert row["ospa"] < 25.0


def test_the_table_has_every_scenario_and_its_metric() -> None:
    truth = [np.array([[0.0, 0.0], [100.0, 0.0]]), np.zeros((0, 2))]
    answers = [np.array([[3.0, 0.0]]), np.zeros((0, 2))]
    assert circular_error_probability((truth, answers)) == 0.5
    assert {row[0] for row in sources().rows} == set(METRICS)
    late, now = (play("garcia-fernandez-2018", agent, [500_000]) for agent in ("trajectory-pmb", "pmb"))
    np.testing.assert_array_equal(np.concatenate(late[0][0]), np.concatenate(now[0][0]))
    metric = METRICS["garcia-fernandez-2018"]
    value, number = score(metric, now)
    assert value.low <= value.value <= value.high and number.value < 1.0
    assert value.value == pytest.approx(np.sqrt(metric.of_episode(now[0])))


@pytest.mark.slow
def test_the_whole_table_is_written() -> None:
    assert {len(table(name, [500_000]).rows) for name in METRICS if name != MEYER} == {6}
    assert len(table(MEYER, [500_000]).rows) == len(MEYER_FILTERS)


def test_gm_phd_is_as_good_as_published() -> None:
    # Vo and Ma 2006, figure 4: CPEP .0752 and error of the number .2855, of 0 to 1.
    value, number = score(METRICS["vo-ma-2006-pair"], play("vo-ma-2006-pair", "gm-phd", range(100_000, 100_010)))
    assert value.value == pytest.approx(0.0752, abs=0.02) and number.value == pytest.approx(0.2855, abs=0.05)
