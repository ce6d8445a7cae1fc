"""Vector environments: the checkers, bit-identity at larger N, seeds, masks, and invalid input."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.envs.testing import check_vector_env, check_vector_matches_single

IDS = tuple(name for name, entry in ENVIRONMENTS.items() if entry["entry_point"].startswith("servotrack.envs.servo."))
LEVELS = (0, 3, 6)


def small(env_id: str) -> dict[str, Any]:
    """Arguments that make images cheap."""
    return {"image_size": 32} if "Pixels" in env_id else {}


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("env_id", IDS)
def test_it_keeps_the_rules_of_the_vector_api(env_id: str, level: int) -> None:
    check_vector_env(env_id, steps=18, level=level, horizon=7, warmup=1, **small(env_id))


@pytest.mark.parametrize("env_id", IDS)
def test_it_renders(env_id: str) -> None:
    skip = ["determinism", "autoreset", "partial reset", "fresh arrays"]
    check_vector_env(
        env_id, num_envs=2, steps=8, skip=skip, level=3, horizon=5, render_mode="rgb_array", **small(env_id)
    )


@pytest.mark.parametrize("level", range(7))
@pytest.mark.parametrize("env_id", IDS)
def test_it_is_the_single_environment_n_times(env_id: str, level: int) -> None:
    check_vector_matches_single(env_id, num_envs=4, steps=30, level=level, horizon=8, warmup=2, **small(env_id))


def test_terminations_out_of_step_match_too() -> None:
    check_vector_matches_single("UncalibServo-v0", num_envs=6, steps=150, level=3, max_joint_rate=20.0, horizon=200)


def test_a_step_limit_is_that_of_gymnasiums_make() -> None:
    check_vector_matches_single("UncalibServo-v0", level=1, max_episode_steps=6, steps=20)
    check_vector_env("UncalibServo-v0", level=1, max_episode_steps=6, steps=20)


def test_a_hundred_arms_are_a_hundred_single_ones() -> None:
    check_vector_matches_single(
        "UncalibServo-v0", num_envs=100, steps=25, autoreset_modes=[AutoresetMode.SAME_STEP], level=5, horizon=9
    )


def test_waiting_rows_take_no_step_beyond_their_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=2, level=5, horizon=3).unwrapped
    env.reset(seed=0)
    step, most = env.world.step, []

    def watched(*arguments: Any) -> None:
        step(*arguments)
        most.append(int(env.world.steps.max()))

    monkeypatch.setattr(env.world, "step", watched)
    for _ in range(9):
        env.step(np.zeros((2, 2), np.float32))
    assert most == [1, 2, 3, 0, 1, 2, 3, 0, 1]


def test_gymnasium_makes_it_by_default() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=2)
    assert type(env.unwrapped).__name__ == "UncalibServoVectorEnv"
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.unwrapped.max_joint_rate == 2.0


def test_generators_and_seeds_of_sub_environments_are_reported() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=3)
    env.reset(seed=[4, 5, 9])
    assert env.unwrapped.np_random_seed == (4, 5, 9)
    assert len(env.unwrapped.np_random) == 3
    env.reset(seed=[None, 7, None])
    assert env.unwrapped.np_random_seed == (4, 7, 9)


def test_gymnasiums_statistics_count_its_episodes() -> None:
    env = gym.wrappers.vector.RecordEpisodeStatistics(
        gym.make_vec("UncalibServo-v0", num_envs=2, level=0, horizon=4, warmup=0)
    )
    env.reset(seed=0)
    for _ in range(4):
        infos = env.step(np.zeros((2, 2), np.float32))[4]
    assert infos["episode"]["l"].tolist() == [4, 4]


# Bad input


@pytest.fixture
def env() -> Any:
    made = gym.make_vec("UncalibServo-v0", num_envs=3, level=4)
    made.reset(seed=0)
    return made


ZERO = np.zeros((3, 2), np.float32)


@pytest.mark.parametrize("actions", [np.zeros((2, 2)), np.zeros(6), np.zeros((3, 3)), 0.0])
def test_actions_of_another_shape_are_named(env: Any, actions: Any) -> None:
    with pytest.raises(ValueError, match=r"action must have shape \(3, 2\).*, got \("):
        env.step(actions)


def test_actions_that_are_not_finite_are_named(env: Any) -> None:
    actions = ZERO.copy()
    actions[1, 1] = np.nan
    with pytest.raises(ValueError, match="action must be finite, got"):
        env.step(actions)


def test_a_step_before_the_reset_is_refused() -> None:
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before the first step"):
        gym.make_vec("UncalibServo-v0", num_envs=3).step(ZERO)


def test_a_first_reset_by_mask_is_refused() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=3)
    with pytest.raises(ResetNeeded, match="leave out options"):
        env.reset(options={"reset_mask": np.array([True, False, True])})


def test_an_ended_episode_has_to_be_reset_by_the_caller() -> None:
    env = gym.make_vec(
        "UncalibServo-v0", num_envs=3, level=0, horizon=1, warmup=0, autoreset_mode=AutoresetMode.DISABLED
    )
    env.reset(seed=0)
    env.step(ZERO)
    with pytest.raises(ResetNeeded, match=r"sub-environments \[0, 1, 2\] have ended: reset them with"):
        env.step(ZERO)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match=r"sub-environments \[1\] have ended"):
        env.step(ZERO)


@pytest.mark.parametrize(
    ("seed", "error", "message"),
    [
        ([1, 2], ValueError, "list of 3, one for each sub-environment, got 2"),
        ([1, 2, 3, 4], ValueError, "got 4"),
        ([1, -2, 3], ValueError, "seed must be at least 0, got -2"),
        ([1, 2.5, 3], TypeError, "seed must be None or an integer of at least 0, got 2.5"),
        (-1, ValueError, "seed must be at least 0, got -1"),
        ("abc", TypeError, "got 'abc'"),
    ],
)
def test_bad_seeds_are_named_and_change_nothing(env: Any, seed: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        env.reset(seed=seed)
    assert env.unwrapped.np_random_seed == (0, 1, 2)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"reset_mask": [True, False, True]}, TypeError, "must be a NumPy array of bool"),
        ({"reset_mask": np.ones(3)}, TypeError, "must be a NumPy array of bool"),
        ({"reset_mask": np.ones(4, np.bool_)}, ValueError, r"must have shape \(3,\), got \(4,\)"),
        ({"reset_mask": np.zeros(3, np.bool_)}, ValueError, "true for at least one"),
        ({"mask": np.ones(3, np.bool_)}, ValueError, r"reset options \['mask'\] are not known"),
    ],
)
def test_bad_options_are_named(env: Any, options: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        env.reset(options=options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1, got 0"),
        ({"num_envs": 2.0}, "num_envs must be a whole number"),
        ({"max_episode_steps": 0}, "max_episode_steps must be None or at least 1, got 0"),
        ({"render_mode": "human"}, "use gym.make"),
        ({"autoreset_mode": "Sometimes"}, "Sometimes"),
        ({"level": 8}, "level must be a whole number from 0 to 6, got 8"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    from servotrack.envs.servo.vector import UncalibServoVectorEnv

    with pytest.raises(ValueError, match=message):
        UncalibServoVectorEnv(**arguments)
