"""The comparison of SAC with and without hindsight experience replay: short training, table, refused arguments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3 import HerReplayBuffer

from servotrack.baselines.training.goal_learning import (
    NUM_ENVS,
    GoalTask,
    RunResult,
    goal_report,
    main,
    measure_goals,
    reached_by_chance,
    train_goals,
)

TASK = GoalTask("UncalibServoReach-v0", 2, NUM_ENVS * 101 + 40)


@pytest.mark.parametrize("hindsight", [True, False])
def test_both_kinds_train_and_are_measured(hindsight: bool) -> None:
    model, seconds = train_goals(TASK, hindsight, seed=0)
    assert isinstance(model.replay_buffer, HerReplayBuffer) == hindsight
    assert model.num_timesteps >= TASK.steps and model._n_updates > 0
    result = measure_goals(model, TASK, 2, seconds)
    assert -100.0 <= result.returned <= 0.0 and 0.0 <= result.success <= 1.0 and 0.0 <= result.reached <= 1.0


def test_too_few_steps_for_an_episode_are_refused() -> None:
    with pytest.raises(ValueError, match="must exceed 404, one episode of each environment, got 404"):
        train_goals(GoalTask("UncalibServoReach-v0", 2, 404), True, seed=0)


def test_every_run_is_in_the_report() -> None:
    runs = [RunResult(0.5, 0.25, -40.0, 90.0), RunResult(0.75, 0.5, -30.5, 60.0)]
    page = goal_report([TASK], {(TASK.name, True): runs}, {TASK.name: 0.06}, 10, "scripts/goals")
    name = "UncalibServoReach-v0,level=2,threshold=5"
    assert f"| {name} | 444 | 6.0 | hindsight | 50, 75 | 25, 50 | -40.0, -30.5 | 1.5, 1.0 |" in page


def test_random_actions_hardly_reach_a_small_goal() -> None:
    small = GoalTask("UncalibServo3D-v0", 1, 1000, 2.0, {"points": 1, "horizon": 20})
    assert small.name == "UncalibServo3D-v0,level=1,points=1,horizon=20,threshold=2"
    assert reached_by_chance(small, 3) == 0.0
    assert reached_by_chance(replace(small, threshold=1e4), 2) == 1.0


def test_bad_arguments_are_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments, message in (["--runs", "0"], "--runs must be positive"), (["--steps", "9"], "must exceed 164"):
        with pytest.raises(SystemExit):
            main([*arguments, "--output", str(tmp_path)])
        assert message in capsys.readouterr().err
