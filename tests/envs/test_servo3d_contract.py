"""UncalibServo3D follows the rules of Gymnasium and Stable-Baselines3, single and vector, and names bad arguments."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs.servo3d.arms import ARMS, SerialArm
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.wrappers import PrivilegedObservation, VectorPrivilegedObservation

ENV_ID = "UncalibServo3D-v0"
PLAIN = {name: getattr(ARMS["so101"], name) for name in SerialArm.__dataclass_fields__}
KINDS = [
    {"arm": "so101", "camera": "hand", "level": 6},
    {"arm": "panda", "camera": "world", "level": 3},
    {"arm": "ur5e", "camera": "world", "level": 4, "points": 1, "in_view": None},
    {"arm": PLAIN, "camera": "hand", "level": 0, "points": 20},
]


@pytest.mark.parametrize("keywords", KINDS)
def test_both_checkers_are_content(keywords):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ENV_ID, horizon=20, **keywords).unwrapped)
        checker.check_env(gym.make(ENV_ID, horizon=20, **keywords))


def test_vector_environment_keeps_the_rules():
    check_vector_env(ENV_ID, level=3, horizon=6, steps=20)


@pytest.mark.parametrize("keywords", [{"level": 6, "arm": "panda"}, {"level": 4, "arm": "so101", "camera": "world"}])
def test_vector_environment_is_the_single_one_to_the_bit(keywords):
    check_vector_matches_single(ENV_ID, horizon=8, steps=25, **keywords)


def test_privileged_observations_of_oracles():
    env = PrivilegedObservation(gym.make(ENV_ID, arm="panda"))
    observation, _ = env.reset(seed=3)
    assert observation in env.observation_space
    vector = VectorPrivilegedObservation(gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", arm="panda"))
    observations, _ = vector.reset(seed=3)
    assert observations["true_jacobian"].shape == (2, 8, 8)
    for name, value in observation.items():
        assert np.array_equal(value, observations[name][0]), name


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"arm": "ur3"}, "arm must be one of ur5e, panda, so101, a SerialArm, or its fields, got 'ur3'"),
        ({"arm": {"name": "mine"}}, "arm: fields must be those of SerialArm"),
        ({"arm": PLAIN | {"legs": 2}}, "arm: fields must be those of SerialArm"),
        ({"arm": PLAIN | {"high": np.full(5, -1.0)}}, "joint 0 has 0 and limits -1.91986 to -1"),
        ({"arm": PLAIN | {"low": [float("nan")] * 5}}, r"arm: low must be finite numbers of shape \(5,\)"),
        ({"arm": PLAIN | {"axes": np.zeros((5, 3))}}, "arm: axes must be vectors of length > 0"),
        ({"arm": PLAIN | {"axes": "up"}}, r"arm: axes must be numbers of shape \(5, 3\)"),
        ({"arm": PLAIN | {"tool": np.zeros((4, 4))}}, "arm: tool must be a pose"),
        ({"arm": PLAIN | {"masses": -np.ones(5)}}, "arm: masses must be >= 0"),
        ({"camera": "roof"}, "camera must be one of hand, world, got 'roof'"),
        ({"points": 2}, "points must be 1 or at least 4 .fewer leave the goal's pose open., got 2"),
        ({"points": 4.5}, "points must be a whole number, got 4.5"),
        ({"in_view": (2, 5)}, "in_view must be at most points = 4"),
        ({"latency": 0.5}, "latency must be whole numbers"),
        ({"turn": (1.0, 0.5)}, r"turn must be a number or \(low, high\) with low <= high"),
        ({"pixel_noise": float("nan")}, r"pixel_noise must lie in \[0, 50\], got nan"),
        ({"stamped": 1}, "stamped must be True or False, got 1"),
        ({"level": 7}, "level must be a whole number from 0 to 6"),
    ],
)
def test_bad_arguments_are_named(keywords, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ENV_ID, **keywords)


def test_a_layout_that_does_not_exist_is_named():
    env = gym.make(ENV_ID, level=0, board=2.0)
    with pytest.raises(ValueError, match=r"no layout among .* board=2"):
        env.reset(seed=0)


@pytest.mark.parametrize("action", [np.full(5, np.nan), np.zeros(6)])
def test_bad_actions_are_refused(action):
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must"):
        env.step(action)


@pytest.mark.parametrize("keywords", [{"arm": "so101"}, {"arm": "panda", "camera": "world", "points": 1, "level": 0}])
def test_the_picture_changes_with_the_state_and_changes_nothing(keywords):
    env, blind = gym.make(ENV_ID, render_mode="rgb_array", **keywords).unwrapped, gym.make(ENV_ID, **keywords).unwrapped
    before = [e.reset(seed=0)[0]["features"] for e in (env, blind)]
    frames = [env.render()]
    assert frames[0].shape == (540, 960, 3)
    for _ in range(2):
        after = [e.step(np.full(e.action_space.shape, 0.5))[0]["features"] for e in (env, blind)]
        assert np.array_equal(*after)
        frames.append(env.render())
    assert np.array_equal(*before)
    assert (frames[1] != frames[2]).any()
    # Arm and camera's picture both move.
    assert (frames[0][:, :600] != frames[2][:, :600]).any()
    assert (frames[0][:270, 620:] != frames[2][:270, 620:]).any()
