"""Observers of people on video: the contract of `predict`, batches, restarts, and that knowing more scores more."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.people.trackers_package import PEERS
from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.envs.wrappers import PrivilegedObservation

ENV_ID = "PedestrianTracking-v0"
OBSERVERS = tuple(
    name for name, card in AGENTS.items() if "video" in card.worlds and name not in PEERS and name != "random"
)
FRAMES = 12
SMALL = {"width": 192, "height": 144, "horizon": FRAMES, "empty_frames": 0}


@cache
def play(name: str, seeds: tuple[int, ...], observation: str) -> tuple[np.ndarray, np.ndarray]:
    """Answers and rewards, shapes (frames, N, rows, 1 + d) and (frames, N)."""
    card = agent_card(name)
    env = make_vector(ENV_ID, len(seeds), {**SMALL, "observation": observation}, privileged=card.privileged)
    agent = create_agent(card, env)
    seen, _ = env.reset(seed=list(seeds))
    state, starts = None, np.ones(len(seeds), bool)
    answers, rewards = [], []
    for _ in range(FRAMES):
        answer, state = agent.predict(seen, state, starts)
        assert answer in env.action_space
        starts = np.zeros(len(seeds), bool)
        seen, reward, *_ = env.step(answer)
        answers.append(answer)
        rewards.append(reward)
    env.close()
    return np.array(answers), np.array(rewards)


@pytest.mark.parametrize("observation", ["pixels", "blobs", "centroids"])
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_batch_answers_as_its_rows_do(name: str, observation: str) -> None:
    together, _ = play(name, (5, 6), observation)
    alone, _ = play(name, (6,), observation)
    assert np.array_equal(together[:, 1], alone[:, 0])


@pytest.mark.parametrize("name", OBSERVERS)
def test_single_observations_are_served_and_restarts_forget(name: str) -> None:
    card = agent_card(name)
    env: gym.Env = gym.make(ENV_ID, observation="blobs", **SMALL)
    if card.privileged:
        env = PrivilegedObservation(env)
    agent = create_agent(card, env)

    def episode(state: object) -> tuple[list[np.ndarray], object]:
        seen, _ = env.reset(seed=1)
        answers = []
        for step in range(FRAMES):
            answer, state = agent.predict(seen, state, np.array(step == 0))
            assert answer in env.action_space
            answers.append(answer)
            seen, *_ = env.step(answer)
        return answers, state

    first, state = episode(None)
    again, _ = episode(state)
    assert np.array_equal(first, again)
    env.close()


@pytest.mark.parametrize("observation", ["pixels", "centroids"])
def test_the_oracle_loses_nothing(observation: str) -> None:
    _, rewards = play("people-oracle", (5, 6), observation)
    assert np.abs(rewards).max() < 1e-9


def test_what_an_observer_knows_shows_in_its_score() -> None:
    random, raw = play("random", (5, 6), "blobs")[1].mean(), play("raw-measurements", (5, 6), "blobs")[1].mean()
    assert random < raw < play("people-oracle", (5, 6), "blobs")[1].mean()


def test_a_real_sequence_is_answered() -> None:
    env = gym.make("VideoTracking-v0", observation="detections", horizon=10 + FRAMES)
    agent = create_agent("pmb", env)
    seen, _ = env.reset(seed=0)
    state, reported = None, 0.0
    for step in range(10 + FRAMES):
        answer, state = agent.predict(seen, state, np.array(step == 0))
        seen, *_ = env.step(answer)
        reported = (answer[:, 0] >= 0.5).sum()
    assert reported > 0
    env.close()


def test_other_worlds_are_refused() -> None:
    with pytest.raises(ValueError, match="PedestrianTracking-v0"):
        create_agent("kalman-hungarian", gym.make("ClutterTracking-v0"))
