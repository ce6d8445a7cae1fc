"""A network behind an agent that knows whom to follow: it starts from what that one does."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.agents.learned.follow_corrector import BehindFollower
from servotrack.baselines.agents.registry import create_agent

SETTINGS: dict[str, Any] = {"kind": "servo", "lags": [1, 2], "follower": "phd-servo"}


def environment(count: int = 3, **arguments: Any) -> Any:
    return gym.make_vec(
        "PedestrianServo-v0", num_envs=count, vectorization_mode="vector_entry_point", level=2, **arguments
    )


def started() -> tuple[Any, BehindFollower, Any, Any, Any]:
    """Three episodes before their first step: environment, encoding, observation, memory and no action yet."""
    env = environment()
    encoding = create_encoding(SETTINGS, env)
    assert isinstance(encoding, BehindFollower)
    observation, _ = env.reset(seed=[100_000, 100_001, 100_002])
    return env, encoding, observation, encoding.initial(observation), np.zeros((3, 2), np.float32)


def test_without_a_correction_it_does_what_the_follower_does() -> None:
    env, encoding, observation, memory, action = started()
    classical, state = create_agent("phd-servo", env), None
    for _ in range(25):
        memory, rows = encoding.step(memory, observation, action)
        expected, state = classical.predict(observation, state)
        _, action = encoding.act(memory, np.zeros((3, 2), np.float32))
        assert np.array_equal(action, expected)
        assert rows.shape == (3, encoding.size) and np.array_equal(rows[:, -3:-1], expected)
        assert np.array_equal(encoding.act(memory, np.full((3, 2), 0.5, np.float32))[1], expected + np.float32(0.5))
        observation, *_ = env.step(action)
    assert np.isfinite(rows).all()


def test_what_it_sees_of_the_person_is_what_a_servo_would_see() -> None:
    env, encoding, observation, memory, action = started()
    for _ in range(10):
        memory, rows = encoding.step(memory, observation, action)
        _, action = encoding.act(memory, action)
        truth = env.unwrapped.world.features.copy()
        observation, *_ = env.step(action)
    # Three pixels of noise; one of the three may follow somebody else.
    assert np.median(np.hypot(*(memory.follow.belief - truth).T)) < 10.0
    # The error that a row begins with is that of the believed place, turned: its length is the same.
    error = memory.follow.belief - encoding.follower.goal(observation)
    visible = rows[:, 6] > 0.5
    assert visible.any()
    assert np.allclose(np.hypot(*rows[visible, :2].T), np.hypot(*error[visible].T) / 100.0, atol=1e-4)


def test_features_of_the_person_may_be_read_flat() -> None:
    env = environment()
    encoding = create_encoding({"kind": "flat", "follower": "phd-servo"}, env)
    observation, _ = env.reset(seed=[100_000, 100_001, 100_002])
    _, rows = encoding.step(encoding.initial(observation), observation, np.zeros((3, 2), np.float32))
    # Behind features, frame time and goal: angles from -2 pi to 2 pi, scaled by their own bounds and no others.
    assert np.allclose(rows[:, 5:7], observation["joint_angles"] / (2.0 * np.pi), atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({**SETTINGS, "follower": "kf"}, "encoding.follower must be the name of an agent that follows"),
        ({**SETTINGS, "kind": "steering"}, "is not a known field; known are kind, frames"),
        ({"kind": "steering", "follower": "phd-servo"}, "encoding.follower is not a known field"),
        ({**SETTINGS, "residual": "kf"}, "choose|PedestrianServo|needs an environment"),
        ({**SETTINGS, "colors": 3}, "encoding.colors is not a known field"),
        ({**SETTINGS, "follower": "random"}, "encoding.follower must be the name of an agent that follows"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        create_encoding(settings, environment(1))
