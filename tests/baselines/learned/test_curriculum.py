"""Trainings whose environments change: stages side by side, one stage after the other, the same again after a kill."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from servotrack.baselines.agents.learned.card import load_card
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.training.curriculum import Curriculum
from servotrack.baselines.training.dispatch import train
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.reinforcement import create_model
from servotrack.baselines.training.run import TrainingTask
from servotrack.baselines.training.settings import TrainingSettings

SERVO = TrainingSettings(
    "ppo",
    "ppo",
    n_envs=5,
    n_timesteps=200,
    encoding={"kind": "servo"},
    curriculum=((2,), (3, 4)),
    measurements=1,
    hyper_parameters={"n_steps": 10, "batch_size": 50},
)


def task(folder: Path, settings: TrainingSettings = SERVO) -> TrainingTask:
    return TrainingTask("UncalibServo-v0", {"level": 4, "horizon": 80}, settings, 0, folder, tensorboard=False)


def stages(env: Any) -> list[int]:
    return [int(level) for level in env.get_attr("level")]


def test_one_stage_follows_the_other_and_cuts_the_episodes_that_run(tmp_path: Path) -> None:
    env: Any = create_model(task(tmp_path)).get_env()
    assert isinstance(env, Curriculum) and env.stage == 0 and stages(env) == [2] * 5
    env.reset()
    action = np.zeros((5, 2), np.float32)
    for _ in range(19):
        _, _, done, _ = env.step(action)
        assert not done.any() and stages(env) == [2] * 5
    rows, _, done, infos = env.step(action)
    assert done.all() and env.stage == 1 and stages(env) == [3, 3, 3, 4, 4]
    for row, info in zip(rows, infos, strict=True):
        assert info["TimeLimit.truncated"] and not np.array_equal(info["terminal_observation"], row)
    # Each of the new environments has an episode of its own.
    assert len(np.unique(rows[:, :2], axis=0)) == 5
    for _ in range(40):
        assert not env.step(action)[2].any()


def test_after_an_interruption_the_stage_is_that_of_the_steps(tmp_path: Path) -> None:
    env: Any = create_model(task(tmp_path), steps=120).get_env()
    assert env.stage == 1 and stages(env) == [3, 3, 3, 4, 4]


def test_a_curriculum_trains_and_its_card_says_for_which_levels(tmp_path: Path) -> None:
    yard = PeriodicEvaluation(
        "UncalibServo-v0", {"level": 4, "horizon": 80}, ResultsFolder(tmp_path / "classical"), episodes=2
    )
    curve = train(task(tmp_path / "run"), yard)
    assert curve.steps >= 200
    card = load_card(tmp_path / "run" / "agent.json")
    assert card.levels == [3, 4] and card.training["settings"]["curriculum"] == [[2], [3, 4]]
    assert [name.split(",")[-1] for name in card.environments] == ["level=3", "level=4"]
    # Nothing is left to do, and the folder is still known as that of this training.
    assert train(task(tmp_path / "run"), yard).entries == curve.entries


@pytest.mark.parametrize("curriculum", [5, [5], [[]], [["hard"]], [[True]], [[1, 2, 3, 4, 5, 6]]])
def test_curricula_that_nobody_can_use_are_refused(curriculum: Any) -> None:
    fields = {"n_envs": 5, "encoding": {"kind": "servo"}}
    with pytest.raises(ValueError, match="curriculum must be a list of stages"):
        TrainingSettings("ppo", "ppo", curriculum=curriculum, **fields)
    with pytest.raises(ValueError, match="reinforcement learning only, got it with student"):
        TrainingSettings("student", "student", curriculum=((2,),), **fields)


def test_even_little_steering_finds_targets_that_appear_where_the_filter_was_not_told(tmp_path: Path) -> None:
    settings = TrainingSettings(
        "steering", "ppo", n_envs=6, n_timesteps=300, measurements=1, encoding={"kind": "steering"},
        curriculum=((5, 6, 7),), hyper_parameters={"n_steps": 25, "batch_size": 50},
    )  # fmt: skip
    folder = ResultsFolder(tmp_path / "classical")
    yard = PeriodicEvaluation("ClutterTracking-v0", {"level": 7, "horizon": 30}, folder, episodes=4)
    steering = TrainingTask(
        "ClutterTracking-v0", {"level": 7, "horizon": 30}, settings, 0, tmp_path / "run", tensorboard=False
    )
    curve = train(steering, yard)
    # Births anywhere, even as few as an untrained network expects, find targets that the told sites do not.
    assert curve.entries[-1]["return"] > yard.beside["gm-phd"]["return"]
