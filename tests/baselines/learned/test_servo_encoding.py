"""What a learned servo sees: the error turned with arm and camera, the same in a batch and alone."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.agents.learned.flat_encoding import FlatEncoding, Stacked
from servotrack.baselines.agents.learned.servo_encoding import ServoEncoding
from servotrack.baselines.agents.learned.servo_parts import ResidualMemory
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo, servo_measurement

CLEAN = {
    "distortion": 0.0, "tilt": 0.0, "aspect": 0.0, "principal_offset": 0.0, "pixel_noise": 0.0, "camera_size": 4096,
}  # fmt: skip
"""A pinhole that looks straight down, without noise, and sees everything."""
ROWS = 8


def _run(env: Any, encoding: Any, steps: int, seed: int = 100_000) -> list[NDArray[np.float32]]:
    """Rows of an encoding while arms move at random."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=[seed + i for i in range(env.num_envs)])
    memory, action = encoding.initial(observation), np.zeros((env.num_envs, 2), np.float32)
    rows = []
    for _ in range(steps):
        memory, row = encoding.step(memory, observation, action)
        rows.append(row)
        action = rng.uniform(-0.5, 0.5, (env.num_envs, 2)).astype(np.float32)
        observation, *_ = env.step(action)
    return rows


def test_the_turned_error_points_where_the_target_is() -> None:
    """Up to the weak belief in a straight mounting, whose weight falls as the arm moves."""
    env = gym.make_vec("UncalibServo-v0", num_envs=ROWS, level=3, target="point", links=0.5, **CLEAN)
    row = _run(env, ServoEncoding(), 31)[-1]
    # The last row was made before the last step.
    same = gym.make_vec("UncalibServo-v0", num_envs=ROWS, level=3, target="point", links=0.5, **CLEAN)
    _run(same, ServoEncoding(), 30)
    place = same.unwrapped.world.target[:, :2] - same.unwrapped.world.tool  # type: ignore[attr-defined]
    off = np.arctan2(row[:, 1], row[:, 0]) - np.arctan2(place[:, 1], place[:, 0])
    weight_of_straight = np.exp(-5.0 * row[:, -2])
    assert weight_of_straight.max() < 0.1
    assert (np.abs(np.sin(off)) < weight_of_straight + 1e-3).all() and (np.cos(off) > 0.0).all()


def test_mounting_is_unknown_before_the_arm_moves() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=ROWS, level=3)
    encoding = ServoEncoding()
    first, *_, last = _run(env, encoding, 30)
    assert (first[:, -2] == 0.0).all() and (last[:, -2] > 0.0).all()


def test_the_age_that_explains_the_motion_is_taken() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=64, level=6)
    row = _run(env, ServoEncoding(ages=(0.2, 1.2, 2.2)), 80)[-1]
    hidden = env.unwrapped.world.latency  # type: ignore[attr-defined]
    assert set(hidden.tolist()) == {0, 1, 2}
    assert np.mean(np.round(row[:, -1] - 0.2) == hidden) > 0.8


def test_rows_are_alike_alone_and_in_a_batch() -> None:
    many = gym.make_vec("UncalibServo-v0", num_envs=ROWS, level=6)
    batched = _run(many, ServoEncoding(ages=(0.2, 1.2)), 20)
    encoding, rng = ServoEncoding(ages=(0.2, 1.2)), np.random.default_rng(100_000)
    env = gym.make("UncalibServo-v0", level=6)
    observation, _ = env.reset(seed=100_000 + 3)
    memory: Any = None
    action = np.zeros((1, 2), np.float32)
    for row in batched:
        one = {key: value[None] for key, value in observation.items()}
        memory = encoding.initial(one) if memory is None else memory
        memory, alone = encoding.step(memory, one, action)
        assert np.array_equal(alone[0], row[3])
        action = rng.uniform(-0.5, 0.5, (ROWS, 2)).astype(np.float32)[3:4]
        observation, *_ = env.step(action[0])


def test_steps_leave_the_memory_that_they_were_given_alone() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=2)
    observation, _ = env.reset(seed=[100_000, 100_001])
    encoding = ServoEncoding()
    memory = encoding.initial(observation)
    before = [part.copy() for part in memory]
    encoding.step(memory, observation, np.zeros((2, 2), np.float32))
    assert all(np.array_equal(a, b) for a, b in zip(before, memory, strict=True))


def test_a_stack_repeats_the_first_row_and_then_shifts() -> None:
    space = gym.spaces.Box(np.zeros(2), np.array([1.0, 4.0]))
    encoding = Stacked(FlatEncoding.of(space), 3)
    memory, none = encoding.initial(np.zeros((1, 2))), np.zeros((1, 1), np.float32)
    memory, first = encoding.step(memory, np.array([[0.5, 4.0]]), none)
    memory, second = encoding.step(memory, np.array([[1.0, 0.0]]), none)
    assert first.tolist() == [[0.0, 1.0] * 3]
    assert second.tolist() == [[0.0, 1.0, 0.0, 1.0, 1.0, -1.0]]


def test_a_residual_starts_from_what_the_classical_servo_does() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=3, level=3)
    encoding = create_encoding({"kind": "servo", "residual": "kf"}, env)
    observation, _ = env.reset(seed=[100_000, 100_001, 100_002])
    memory = encoding.initial(observation)
    classical, state = create_agent("kf", env), None
    for _ in range(20):
        memory, row = encoding.step(memory, observation, np.zeros((3, 2), np.float32))
        action, state = classical.predict(observation, state)
        assert isinstance(memory, ResidualMemory)
        done = encoding.act(memory, np.full((3, 2), 0.25, np.float32))[1]
        assert np.array_equal(done, action + np.float32(0.25)) and np.array_equal(row[:, -2:], action)
        observation, *_ = env.step(action)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "wavelets"}, "encoding.kind must be one of"),
        ({"kind": "set"}, "kind servo, steering, flat or raw"),
        ({"kind": "servo", "frame": 3}, "encoding.frame is not a known field; did you mean 'frames'"),
        ({"kind": "servo", "lags": [3, 1]}, "ascending"),
        ({"kind": "servo", "ages": []}, "encoding.ages must be a list of 1 to 16"),
        ({"kind": "flat", "lags": [1]}, "encoding.lags is not a known field"),
        ({"kind": "flat", "frames": 0}, "encoding.frames must be a whole number in 1 to 64"),
        ({"kind": "servo", "residual": "random"}, "classical servo"),
        ({"kind": "servo", "residual": "kfs"}, "name of a classical servo.*did you mean 'kf'"),
        ({"kind": "servo", "residual": "oracle"}, "name of a classical servo"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    env = gym.make("UncalibServo-v0")
    with pytest.raises(ValueError, match=message):
        create_encoding(settings, env)


def test_other_worlds_are_refused() -> None:
    with pytest.raises(ValueError, match="two joints and two features"):
        create_encoding({"kind": "servo"}, gym.make("ClutterTracking-v0"))
    with pytest.raises(ValueError, match="bounded"):
        FlatEncoding.of(gym.spaces.Box(-np.inf, np.inf, (2,)))


def test_identified_rows_end_with_the_estimate_of_the_servo() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=3, level=2)
    encoding = create_encoding({"kind": "servo", "identifier": "lifted-kf"}, env)
    servo = create_agent("lifted-kf", env)
    assert isinstance(servo, JacobianServo)
    observation, _ = env.reset(seed=[7, 8, 9])
    memory, state = encoding.initial(observation), servo.controller.estimator.initial(servo_measurement(observation))
    action = np.zeros((3, 2), np.float32)
    rng = np.random.default_rng(0)
    for _ in range(40):
        memory, rows = encoding.step(memory, observation, action)
        state, estimate = servo.controller.estimator.step(state, servo_measurement(observation))
        action = rng.uniform(-0.2, 0.2, (3, 2)).astype(np.float32)
        observation, *_ = env.step(action)
    assert rows.shape == (3, encoding.size) == (3, ServoEncoding().size + 10)
    np.testing.assert_allclose(rows[:, -10:-8], estimate.error / 100.0, rtol=1e-5)
    np.testing.assert_allclose(rows[:, -8:-2], estimate.jacobian.reshape(3, 6) / 300.0, rtol=1e-4, atol=1e-6)
    # The last entries are the action that moves the image by the error and the target's drift in one period.
    motion = rows[:, -2:] * servo.controller.max_joint_rate * 0.05
    inside = np.abs(rows[:, -2:]).max(axis=1) < 2.0
    left = np.einsum("nij,nj->ni", estimate.jacobian[..., :2], motion) + estimate.predict_error(np.zeros((3, 2)), 0.05)
    assert inside.any()
    assert np.abs(left[inside]).max() < 1.0
    env.close()


def test_an_identifier_must_be_a_servo() -> None:
    env = gym.make_vec("UncalibServo-v0", num_envs=1)
    with pytest.raises(ValueError, match="identifier"):
        create_encoding({"kind": "servo", "identifier": "ppo"}, env)
    env.close()
