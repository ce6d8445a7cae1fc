"""Agents of the color world: the contract of `predict`, batches, restarts, and that knowing more scores more."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.color.catalog import COLOR_TRACKERS, color_tracker
from servotrack.baselines.agents.color.observers import create_color_observer
from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector, run_episodes
from servotrack.baselines.tuning.color_films import film, track

ENV_ID = "ColorTracking-v0"
AGENT_NAMES = tuple(name for name, card in AGENTS.items() if card.factory.endswith("create_color_observer"))
FAST = tuple(name for name in AGENT_NAMES if name != "mil")
FRAMES = 6
SMALL = {"horizon": FRAMES, "width": 160, "height": 120, "head_height": 30.0}


def play(name: str, seeds: list[int]) -> np.ndarray:
    """Answers, shape (frames, N, 4)."""
    card = agent_card(name)
    env = make_vector(ENV_ID, len(seeds), SMALL, privileged=card.privileged)
    agent = create_agent(card, env)
    observation, _ = env.reset(seed=seeds)
    state, starts, answers = None, np.ones(len(seeds), bool), []
    for _ in range(FRAMES):
        answer, state = agent.predict(observation, state, starts)
        assert answer in env.action_space
        starts = np.zeros(len(seeds), bool)
        observation, *_ = env.step(answer)
        answers.append(answer)
    return np.array(answers)


@pytest.mark.parametrize("name", FAST)
def test_a_batch_answers_as_its_rows_do(name: str) -> None:
    assert np.array_equal(play(name, [5, 6])[:, 1], play(name, [6])[:, 0])


@pytest.mark.parametrize("name", FAST)
def test_single_observations_are_served_and_restarts_forget(name: str) -> None:
    card = agent_card(name)
    env: gym.Env = gym.make(ENV_ID, **SMALL)
    if card.privileged:
        from servotrack.envs.wrappers import PrivilegedObservation

        env = PrivilegedObservation(env)
    agent = create_agent(card, env)

    def episode(state: object) -> tuple[list[np.ndarray], object]:
        observation, _ = env.reset(seed=1)
        answers = []
        for step in range(FRAMES):
            answer, state = agent.predict(observation, state, np.array(step == 0))
            assert answer.shape == (4,)
            answers.append(answer)
            observation, *_ = env.step(answer)
        return answers, state

    first, state = episode(None)
    again, _ = episode(state)
    assert np.array_equal(first, again)


def test_an_agent_is_its_tracker() -> None:
    seen = film(3, **SMALL)
    expected = track(color_tracker("monte-carlo-color"), seen).boxes
    assert np.array_equal(play("monte-carlo-color", [3])[:, 0], expected)


def test_what_is_known_shows_in_the_columns_of_an_episode() -> None:
    kwargs = {**SMALL, "horizon": 25, "level": 0}
    rows = {
        name: run_episodes(ENV_ID, agent_card(name), [100_000, 100_001], kwargs)[0]
        for name in ("random", "first-box", "monte-carlo-color-plus", "box-oracle")
    }
    mean = {name: np.mean([row["auc"] for row in found]) for name, found in rows.items()}
    assert mean["random"] < mean["first-box"] < mean["monte-carlo-color-plus"] < mean["box-oracle"]
    for row in rows["box-oracle"]:
        assert row["auc"] == pytest.approx(20 / 21)
        assert (row["iou"], row["precision"], row["failures"]) == (pytest.approx(1.0), 1.0, 0.0)
        assert row["return"] == pytest.approx(25.0)


def test_every_tracker_has_a_card_but_those_that_need_another_wheel() -> None:
    assert set(COLOR_TRACKERS) - {"csrt", "kcf"} == set(AGENT_NAMES) - {"first-box", "box-oracle"}
    assert not AGENTS["mil"].in_default_suite
    assert all(AGENTS[name].worlds == {"color"} for name in AGENT_NAMES)


def test_other_worlds_and_trackers_are_refused() -> None:
    with pytest.raises(ValueError, match="needs the observations frame and first_box"):
        create_agent("monte-carlo-color", gym.make("ClutterTracking-v0"))
    with pytest.raises(ValueError, match="color tracker must be one of"):
        create_color_observer(gym.make(ENV_ID, **SMALL), "snake")
