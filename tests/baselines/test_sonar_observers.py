"""Observers of the sonar world: the contract of `predict`, batches, restarts, the lag; who knows more scores more."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.agents.sonar.observers import SonarObserver
from servotrack.baselines.evaluation.evaluate import evaluate, make_single, make_vector
from servotrack.estimators.rfs import SetEstimate

ENV_ID = "SonarTracking-v0"
OBSERVERS = tuple(name for name, card in AGENTS.items() if card.factory.endswith("create_sonar_observer"))
SETTINGS = {"level": 1, "horizon": 22, "lag": 3, "beams": 181, "elements": 24, "bin_width": 25.0, "snapshots": 25}


class Loudest:
    """Reports the loudest beam under one label."""

    def __init__(self, looks):
        self.looks = looks

    def initial(self, record):
        return 0

    def step(self, state, record):
        one = np.ones(1)
        estimate = SetEstimate(
            states=self.looks[record.argmax()] * np.ones((1, 1)),
            labels=np.ones(1, np.int64),
            existence=one,
            covariances=np.ones((1, 1, 1)),
            expected_number=np.ones(()),
            held_labels=np.zeros(0, np.int64),
            held_states=np.zeros((0, 1)),
            held_existence=np.zeros(0),
        )
        return state + 1, estimate


def play(name, seeds, settings=SETTINGS):
    """Answers and rewards, shapes (steps, N, rows, 2) and (steps, N)."""
    card = agent_card(name)
    env = make_vector(ENV_ID, len(seeds), settings, privileged=card.privileged)
    agent = create_agent(card, env)
    observation, _ = env.reset(seed=seeds)
    state, starts = None, np.ones(len(seeds), bool)
    answers, rewards = [], []
    for _ in range(settings["horizon"] + settings["lag"]):
        answer, state = agent.predict(observation, state, starts)
        assert answer in env.action_space
        starts = np.zeros(len(seeds), bool)
        observation, reward, *_ = env.step(answer)
        answers.append(answer)
        rewards.append(reward)
    return np.array(answers), np.array(rewards)


@pytest.mark.parametrize("name", OBSERVERS)
def test_a_batch_answers_as_its_rows_do(name):
    together, _ = play(name, [5, 6])
    alone, _ = play(name, [6])
    assert np.array_equal(together[:, 1], alone[:, 0])


@pytest.mark.parametrize("name", OBSERVERS)
def test_restarts_forget(name):
    card = agent_card(name)
    env = make_single(ENV_ID, SETTINGS, privileged=card.privileged)
    agent = create_agent(card, env)

    def episode(state, seed):
        observation, _ = env.reset(seed=seed)
        answers = []
        for step in range(20):
            answer, state = agent.predict(observation, state, np.array(step == 0))
            answers.append(answer)
            observation, *_ = env.step(answer)
        return np.array(answers), state

    _, state = episode(None, 8)
    after, _ = episode(state, 9)
    fresh, _ = episode(None, 9)
    assert np.array_equal(after, fresh)


def test_the_truth_scores_best_and_the_row_is_not_far_behind():
    rewards = {name: play(name, [3, 4])[1].sum() for name in ("bearing-oracle", "hmm-row")}
    silence = -2 * (SETTINGS["horizon"] - 10.0)
    assert rewards["bearing-oracle"] == 0.0
    assert silence / 2 < rewards["hmm-row"] < 0.0


def test_identities_keep_their_rows():
    looks = np.linspace(0.0, 180.0, 181)
    low, high = np.zeros((4, 2)), np.tile([1.0, 180.0], (4, 1))
    observer = SonarObserver(Loudest(looks), low, high)
    record = np.zeros(181)
    record[77] = 9.0
    answer, state = observer.predict(record)
    assert answer[0].tolist() == [1.0, 77.0]
    assert not answer[1:].any()
    record[99] = 10.0
    again, _ = observer.predict(record, state)
    assert again[0].tolist() == [1.0, 99.0]


def test_unscored_answers_do_not_count_in_results():
    rows = evaluate(ENV_ID, "bearing-oracle", [100_000, 100_001], SETTINGS, timing=False).rows
    assert all(row["ospa"] == row["ospa2"] == 0.0 and row["count_right"] == 1.0 for row in rows)
    assert all(row["length"] == 25 for row in rows)


def test_another_world_is_refused():
    with pytest.raises(ValueError, match=r"'hmm-row' needs an environment.*SonarModel.*choose SonarTracking-v0"):
        create_agent("hmm-row", gym.make("ClutterTracking-v0"))
    with pytest.raises(ValueError, match=r"'pmb' needs an environment.*is a SceneModel; SonarTracking-v0 has none"):
        create_agent("pmb", gym.make(ENV_ID))
