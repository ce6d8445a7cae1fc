"""Single environments: checks of Gymnasium and Stable-Baselines3, and error messages for invalid input."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.envs.servo.levels import NOISE_KINDS, TARGETS

IDS = tuple(name for name, entry in ENVIRONMENTS.items() if entry["entry_point"].startswith("servotrack.envs.servo."))
LEVELS = range(7)
EVERY = [(env_id, level) for env_id in IDS for level in LEVELS]


@pytest.mark.parametrize(("env_id", "level"), EVERY)
def test_gymnasiums_checker_has_no_complaint(env_id: str, level: int) -> None:
    env = gym.make(env_id, level=level, horizon=30)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasiums_checker_of_rendering_has_no_complaint(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize(("env_id", "level"), EVERY)
def test_stable_baselines_checker_has_no_complaint(env_id: str, level: int) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gym.make(env_id, level=level, horizon=30).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines_evaluates_it(env_id: str) -> None:
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    monitor = pytest.importorskip("stable_baselines3.common.monitor")

    class Still:
        def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Any, Any]:
            return np.zeros((1, 2), np.float32), state

    env = monitor.Monitor(gym.make(env_id, level=0, horizon=5, warmup=2))
    returns, lengths = evaluation.evaluate_policy(Still(), env, n_eval_episodes=2, return_episode_rewards=True)
    assert lengths == [7, 7]
    assert all(0 < total < 5 for total in returns)


@pytest.mark.parametrize(("env_id", "level"), EVERY)
def test_observations_of_random_agents_stay_in_their_space(env_id: str, level: int) -> None:
    env = gym.make(env_id, level=level, disable_env_checker=True)
    env.action_space.seed(level)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            assert observation in env.observation_space
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert 0.0 <= reward <= 1.0
            over = terminated or truncated


@pytest.mark.parametrize("env_id", IDS)
def test_every_bound_is_finite_and_spaces_are_made_once(env_id: str) -> None:
    env = gym.make(env_id).unwrapped
    spaces = env.observation_space, env.action_space
    assert isinstance(spaces[0], gym.spaces.Dict)
    for box in spaces[0].values():
        assert isinstance(box, gym.spaces.Box) and box.is_bounded()
    env.reset(seed=0)
    assert (env.observation_space, env.action_space) == spaces
    assert env.observation_space is spaces[0] and env.action_space is spaces[1]


@pytest.mark.parametrize("env_id", IDS)
def test_what_was_returned_does_not_change(env_id: str) -> None:
    env = gym.make(env_id, level=5, disable_env_checker=True)
    held, info = env.reset(seed=0)
    copies = {key: value.copy() for key, value in held.items()}
    truth = {key: value.copy() for key, value in info["truth"].items()}
    for _ in range(5):
        env.step(np.ones(2, np.float32))
    env.reset(seed=1)
    for key, value in copies.items():
        np.testing.assert_array_equal(held[key], value)
    for key, value in truth.items():
        np.testing.assert_array_equal(info["truth"][key], value)


@pytest.mark.parametrize("env_id", IDS)
def test_a_seed_decides_this_episode_and_the_later_ones(env_id: str) -> None:
    one, two = (gym.make(env_id, level=4, disable_env_checker=True) for _ in range(2))
    one.reset(seed=5)
    two.reset(seed=5)
    for _ in range(3):
        # However long an episode was, the next one is the same.
        one.step(np.zeros(2, np.float32))
    for _ in range(2):
        first, second = one.reset()[0], two.reset()[0]
        for key in first:
            np.testing.assert_array_equal(first[key], second[key])
    assert not np.array_equal(one.reset()[0]["joint_angles"], two.reset(seed=6)[0]["joint_angles"])
    assert one.unwrapped.np_random_seed == 5


def test_info_is_about_the_present() -> None:
    env = gym.make("UncalibServo-v0", level=0, warmup=0)
    _, info = env.reset(seed=0)
    assert set(info) == {"tracking_error", "feature_error", "success", "is_success", "truth"}
    truth = info["truth"]
    assert set(truth) == {"joint_angles", "tool", "target", "target_velocity"}
    np.testing.assert_allclose(truth["tool"], [0.5, 0.5])
    assert info["tracking_error"] == pytest.approx(np.hypot(*(truth["tool"] - truth["target"])))
    assert info["feature_error"] == pytest.approx(info["tracking_error"] * 160 / 0.35)
    assert info["success"] is False


def test_gymnasiums_step_limit_truncates() -> None:
    env = gym.make("UncalibServo-v0", level=0, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(np.zeros(2, np.float32))[3] for _ in range(3)] == [False, False, True]


# Bad input

ZERO = np.zeros(2, np.float32)


@pytest.fixture
def env() -> gym.Env[Any, Any]:
    made = gym.make("UncalibServo-v0", level=0, horizon=3, warmup=0).unwrapped
    made.reset(seed=0)
    return made


@pytest.mark.parametrize("action", [0.5, np.zeros(3), np.zeros((1, 2)), None, []])
def test_actions_of_another_shape_are_named(env: gym.Env[Any, Any], action: Any) -> None:
    with pytest.raises(ValueError, match=r"action must have shape \(2,\).*, got \("):
        env.step(action)


@pytest.mark.parametrize("action", [[np.nan, 0.0], [0.0, np.inf], [np.inf, -np.inf]])
def test_actions_that_are_not_finite_are_named(env: gym.Env[Any, Any], action: Any) -> None:
    with pytest.raises(ValueError, match=r"action must be finite, got \[.*(nan|inf).*\]; check the policy"):
        env.step(action)
    # Nothing happened.
    assert env.step(ZERO)[0]["time"] == pytest.approx(0.05)


def test_a_step_before_the_reset_is_refused() -> None:
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        gym.make("UncalibServo-v0").unwrapped.step(ZERO)


def test_a_step_after_the_end_is_refused(env: gym.Env[Any, Any]) -> None:
    assert [env.step(ZERO)[3] for _ in range(3)] == [False, False, True]
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before the first step and after an episode's end"):
        env.step(ZERO)
    env.reset()
    env.step(ZERO)


@pytest.mark.parametrize(("seed", "error"), [(-1, ValueError), (1.5, TypeError), ("0", TypeError), (True, TypeError)])
def test_bad_seeds_are_named_and_change_nothing(env: gym.Env[Any, Any], seed: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=f"seed must be .*, got {seed!r}"):
        env.reset(seed=seed)
    assert env.unwrapped.np_random_seed == 0
    env.reset(seed=np.int64(3))


def test_unknown_reset_options_are_named(env: gym.Env[Any, Any]) -> None:
    with pytest.raises(ValueError, match=r"reset options \['low'\] are not known; parameters are keywords of gym.make"):
        env.reset(seed=9, options={"low": 1})
    assert env.unwrapped.np_random_seed == 0


@pytest.mark.parametrize("env_id", IDS)
def test_bad_keywords_are_named(env_id: str) -> None:
    with pytest.raises(TypeError, match="did you mean 'horizon'"):
        gym.make(env_id, horizn=3)
    with pytest.raises(ValueError, match="level must be a whole number from 0 to 6, got 7"):
        gym.make(env_id, level=7)
    with pytest.raises(ValueError, match="render_mode must be None or one of"):
        type(gym.make(env_id).unwrapped)(render_mode="ascii")


# Any world

RANGE_OF = {
    "links": (0.2, 1.0),
    "focal": (100.0, 300.0),
    "depth": (0.2, 0.8),
    "distortion": (-0.3, 0.3),
    "actuation_noise": (0.0, 0.2),
    "encoder_noise": (0.0, 0.05),
}


@st.composite
def worlds(draw: st.DrawFn) -> dict[str, Any]:
    """Arguments within their bounds; extreme, but not such that no layout can be solved."""

    def between(name: str) -> tuple[float, float]:
        low, high = RANGE_OF[name]
        ends = sorted(draw(st.tuples(st.floats(low, high), st.floats(low, high))))
        return ends[0], ends[1]

    latency = sorted(draw(st.tuples(st.integers(0, 4), st.integers(0, 4))))
    return {name: between(name) for name in RANGE_OF} | {
        "level": draw(st.sampled_from(LEVELS)),
        "target": draw(st.sampled_from(TARGETS)),
        "noise_kind": draw(st.sampled_from(NOISE_KINDS)),
        "mounting": draw(st.floats(0.0, np.pi)),
        "principal_offset": draw(st.floats(0.0, 60.0)),
        "tilt": draw(st.floats(0.0, 0.4)),
        "aspect": draw(st.floats(0.0, 0.5)),
        "pixel_noise": draw(st.floats(0.0, 50.0)),
        "outlier_rate": draw(st.floats(0.0, 1.0)),
        "dropout": draw(st.floats(0.0, 0.95)),
        "rolling_shutter": draw(st.floats(0.0, 0.05)),
        "actuation_gain": draw(st.floats(0.0, 0.5)),
        "max_motor_torque": draw(st.floats(0.1, 1000.0)),
        "max_joint_rate": draw(st.floats(2.0, 20.0)),
        "substeps": draw(st.integers(1, 10)),
        "warmup": draw(st.integers(0, 10)),
        "horizon": draw(st.integers(1, 30)),
        "latency": tuple(latency),
        "stamped": draw(st.booleans()) or latency[1] == 0,
    }


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(arguments=worlds(), seed=st.integers(0, 2**31), push=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)))
def test_no_world_leaves_its_spaces(arguments: dict[str, Any], seed: int, push: tuple[float, float]) -> None:
    env = gym.make("UncalibServo-v0", disable_env_checker=True, **arguments)
    try:
        observation, _ = env.reset(seed=seed)
    except ValueError as error:
        assert "no solvable layout" in str(error)
        return
    over = False
    while not over:
        assert observation in env.observation_space, observation
        observation, reward, terminated, truncated, info = env.step(np.array(push))
        assert 0.0 <= reward <= 1.0
        truth = np.concatenate(list(info["truth"].values()))
        assert np.isfinite([info["tracking_error"], info["feature_error"], *truth]).all()
        over = terminated or truncated
    assert observation in env.observation_space, observation
