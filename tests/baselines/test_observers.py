"""Observers of points in clutter: the contract of `predict`, batches, restarts, and that knowing more scores more."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import evaluate, make_vector

ENV_ID = "ClutterTracking-v0"
OBSERVERS = tuple(name for name, card in AGENTS.items() if card.factory.endswith("create_observer"))
SCANS = 12


def play(name: str, seeds: list[int], **kwargs: object) -> tuple[np.ndarray, np.ndarray]:
    """Answers and rewards, shapes (scans, N, rows, 3) and (scans, N)."""
    card = agent_card(name)
    env = make_vector(ENV_ID, len(seeds), {"horizon": SCANS, **kwargs}, privileged=card.privileged)
    agent = create_agent(card, env)
    observation, _ = env.reset(seed=seeds)
    state, starts = None, np.ones(len(seeds), bool)
    answers, rewards = [], []
    for _ in range(SCANS):
        answer, state = agent.predict(observation, state, starts)
        assert answer in env.action_space
        starts = np.zeros(len(seeds), bool)
        observation, reward, *_ = env.step(answer)
        answers.append(answer)
        rewards.append(reward)
    return np.array(answers), np.array(rewards)


@pytest.mark.parametrize("name", [name for name in OBSERVERS if name != "smc-phd"])
def test_a_batch_answers_as_its_rows_do(name: str) -> None:
    together, _ = play(name, [5, 6, 7])
    alone, _ = play(name, [6])
    assert np.array_equal(together[:, 1], alone[:, 0])


@pytest.mark.parametrize("name", OBSERVERS)
def test_single_observations_are_served_and_restarts_forget(name: str) -> None:
    card = agent_card(name)
    env: gym.Env = gym.make(ENV_ID, horizon=SCANS)
    if card.privileged:
        from servotrack.envs.wrappers import PrivilegedObservation

        env = PrivilegedObservation(env)
    agent = create_agent(card, env)

    def episode(state: object, seed: int) -> tuple[list[np.ndarray], object]:
        observation, _ = env.reset(seed=seed)
        answers = []
        for step in range(SCANS):
            answer, state = agent.predict(observation, state, np.array(step == 0))
            assert answer in env.action_space
            answers.append(answer)
            observation, *_ = env.step(answer)
        return answers, state

    first, state = episode(None, 1)
    again, _ = episode(state, 1)
    if name != "smc-phd":
        assert np.array_equal(first, again)


@pytest.mark.parametrize("level", range(8))
def test_every_level_can_be_filtered(level: int) -> None:
    _, rewards = play("pmb", [1, 2], level=level)
    assert np.isfinite(rewards).all()


def test_what_an_observer_knows_shows_in_its_score() -> None:
    seeds = list(range(100_000, 100_006))
    mean = {
        name: play(name, seeds)[1].mean() for name in ("random", "raw-measurements", "gm-phd", "association-oracle")
    }
    assert mean["random"] < mean["raw-measurements"] < mean["gm-phd"] < mean["association-oracle"]


def test_identities_keep_their_rows() -> None:
    answers, _ = play("pmb", [3], detection_probability=1.0, clutter_rate=0.0)
    reported = answers[2:, 0, :, 0] >= 0.5
    assert (reported == reported[0]).all()
    assert reported[0].sum() == 3


def test_a_servo_is_refused() -> None:
    with pytest.raises(
        ValueError,
        match=r"needs an environment whose `unwrapped\.scene_model` is a SceneModel; UncalibServo-v0 has none",
    ):
        create_agent("gm-phd", gym.make("UncalibServo-v0"))


def test_observers_without_a_smoother_answer_later() -> None:
    at_once, _ = play("pmb", [5, 6])
    late, rewards = play("pmb", [5, 6], lag=4)
    assert not late[:4].any() and not rewards[:4].any()
    assert np.array_equal(late[4:], at_once[:-4])


def test_smoothed_trajectories_score_more_than_late_answers() -> None:
    lag, horizon = 10, 40
    env = gym.make_vec(ENV_ID, 4, level=2, horizon=horizon, lag=lag)
    scores = {}
    for name in ("pmb", "trajectory-pmb"):
        agent = create_agent(name, env)
        observation, _ = env.reset(seed=[1, 2, 3, 4])
        state, total = None, 0.0
        for _ in range(horizon + lag):
            answer, state = agent.predict(observation, state)
            assert answer in env.action_space
            observation, reward, _, _, info = env.step(answer)
            total += reward.mean()
        assert info["episode_scored"].all()
        scores[name] = total, info["ospa2"].mean()
    assert scores["trajectory-pmb"][0] > scores["pmb"][0] + 5.0
    assert scores["trajectory-pmb"][1] < 0.7 * scores["pmb"][1]


def test_the_adaptive_smoother_finds_targets_whose_births_are_stated_wrong() -> None:
    kwargs = {"level": 7, "lag": 10, "horizon": 30}
    ospa = {
        name: np.mean([row["ospa"] for row in evaluate(ENV_ID, name, [1], kwargs).rows])
        for name in ("robust-pmb", "robust-trajectory-pmb")
    }
    assert ospa["robust-trajectory-pmb"] < 0.5 * ospa["robust-pmb"] < 10.0


def test_without_a_lag_the_smoother_is_pmb() -> None:
    assert np.array_equal(play("pmb", [5, 6])[0], play("trajectory-pmb", [5, 6])[0])
