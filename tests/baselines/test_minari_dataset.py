"""Datasets of Minari from vector environments."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines import collect_dataset, create_agent

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")


@pytest.fixture(autouse=True)
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    yield tmp_path


@pytest.mark.parametrize(
    ("env_id", "agent", "kwargs"),
    [
        ("UncalibServo-v0", "kf", {"level": 3, "horizon": 12}),
        ("ClutterTracking-v0", "gm-phd", {"horizon": 5}),
        ("UncalibServo-v0", "oracle", {"level": 1, "horizon": 6}),
    ],
)
def test_episodes_are_those_of_single_environments(env_id: str, agent: str, kwargs: dict[str, Any]) -> None:
    dataset = collect_dataset("test/set-v0", env_id, agent, [5, 3, 9], kwargs, num_envs=2)
    assert dataset.total_episodes == 3
    env: Any = dataset.recover_environment()
    assert env.spec.kwargs.items() >= kwargs.items()
    for episode, seed in zip(dataset.iterate_episodes(), [5, 3, 9], strict=True):
        observation, _ = env.reset(seed=seed)
        for step in range(len(episode)):
            stored = episode.observations
            stored = {key: stored[key][step] for key in stored} if isinstance(stored, dict) else stored[step]
            assert set(stored) == set(observation) if isinstance(stored, dict) else True
            np.testing.assert_equal(stored, observation)
            observation, reward, terminated, truncated, _ = env.step(episode.actions[step])
            assert (reward, terminated, truncated) == (
                episode.rewards[step],
                episode.terminations[step],
                episode.truncations[step],
            )
        assert terminated or truncated
    env.close()


def test_actions_are_the_agents() -> None:
    dataset = collect_dataset("test/set-v0", "UncalibServo-v0", "kf", [4], {"horizon": 10})
    env = gym.make("UncalibServo-v0", horizon=10)
    agent, state, (observation, _) = create_agent("kf", env), None, env.reset(seed=4)
    for action in dataset[0].actions:
        chosen, state = agent.predict(observation, state)
        np.testing.assert_array_equal(action, chosen)
        observation, *_ = env.step(chosen)


def test_chosen_infos_are_stored() -> None:
    dataset = collect_dataset(
        "test/set-v0", "UncalibServo-v0", "random", [1, 2], {"horizon": 4}, info_keys=["tracking_error"]
    )
    assert dataset[0].infos["tracking_error"].shape == (5,)
    assert not np.array_equal(dataset[0].infos["tracking_error"], dataset[1].infos["tracking_error"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": []}, "seeds must be different"),
        ({"seeds": [1, 1]}, "seeds must be different"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"info_keys": ["tracking_eror"]}, "info_keys must name infos that are arrays, .*tracking_error"),
    ],
)
def test_bad_arguments_are_refused(change: dict[str, Any], message: str) -> None:
    arguments = {"seeds": [0], **change}
    with pytest.raises(ValueError, match=message):
        collect_dataset("test/set-v0", "UncalibServo-v0", "random", env_kwargs={"horizon": 3}, **arguments)


class _FailsLater:
    """An agent that acts for some steps only."""

    def __init__(self, env: Any) -> None:
        self._space, self._left = env.action_space, 5

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Any, Any]:
        self._left -= 1
        if self._left < 0:
            raise RuntimeError("the agent stopped")
        return np.zeros(self._space.shape, self._space.dtype), state


def test_a_collection_that_fails_leaves_no_part_of_a_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    def create(card: Any, env: Any) -> Any:
        # The first batch is complete and stored, the second one fails.
        made.append(create_agent("random", env) if not made else _FailsLater(env))
        return made[-1]

    monkeypatch.setattr("servotrack.baselines.evaluation.minari_dataset.create_agent", create)
    with pytest.raises(RuntimeError, match="the agent stopped"):
        collect_dataset("test/set-v0", "UncalibServo-v0", "random", [1, 2], {"horizon": 20}, num_envs=1)
    assert len(made) == 2 and "test/set-v0" not in minari.list_local_datasets()


def test_seeds_are_whole_numbers() -> None:
    with pytest.raises(TypeError, match="float"):
        collect_dataset("test/set-v0", "UncalibServo-v0", "random", [1.5], {"horizon": 3})  # type: ignore[list-item]
