"""Engines of the planar arm: compiled code holds pymunk's bits."""

from __future__ import annotations

import copy
import pickle
import platform
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.envs.servo.arm import Arms
from servotrack.envs.servo.compiled_arms import LANES, CompiledArms
from servotrack.envs.servo.engine import ENGINES, same_bits
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.pymunk_arms import PymunkArms
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW
from servotrack.estimators.types import Array

SERVO_IDS = ("UncalibServo-v0", "UncalibServoReach-v0", "UncalibServoPixels-v0", "PedestrianServo-v0")
LEVELS = range(7)
SETTINGS: tuple[dict[str, Any], ...] = (
    {},
    {"max_motor_torque": 2.0},
    {"max_motor_torque": 0.5, "max_joint_rate": 20.0},
    {"substeps": 3, "solver_iterations": 7},
    {"substeps": 1, "solver_iterations": 1},
)
# The mathematics libraries that pymunk and Numba call are the same one there.
EQUAL = platform.machine() in ("x86_64", "AMD64")


def assert_equal(value: Any, expected: Any, where: str = "") -> None:
    """Compare nested dictionaries of arrays: to the bit on x86-64, to 1e-9 elsewhere."""
    if isinstance(expected, dict):
        assert value.keys() == expected.keys(), where
        for key in expected:
            assert_equal(value[key], expected[key], f"{where}/{key}")
    elif EQUAL or np.asarray(expected).dtype.kind not in "fc":
        np.testing.assert_array_equal(value, expected, err_msg=where)
    else:
        np.testing.assert_allclose(value, expected, rtol=0.0, atol=1e-9, err_msg=where)


def drive(arms: list[Arms], rng: np.random.Generator, steps: int, links: Array, fast: float = 2.0) -> Array:
    """Drive arms alike into their stops and out again, and start some of them anew. Returns the angles seen."""
    count, seen = len(links), []
    rates = rng.uniform(-fast, fast, (count, 2))
    for step in range(steps):
        if step % 25 == 0:
            rates = rng.uniform(-fast, fast, (count, 2))
        again = np.flatnonzero(rng.random(count) < 0.01)
        for each in arms:
            each.reset(again, links[again])
            each.step(rates + 0.1 * np.sin(step + np.arange(2)))
            assert_equal(each.angles, arms[0].angles, f"step {step}")
        seen.append(arms[0].angles.copy())
    return np.array(seen)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_engines_agree_to_the_bit(settings: dict[str, Any]) -> None:
    """Resets in mid-flight, joints at their stops, motors at their limit, and a last block that is not full."""
    config, rng, count = ServoConfig(**settings), np.random.default_rng(0), 4 * LANES + 5
    links = rng.uniform(0.1, 4.0, (count, 2))
    arms = [make(config, count) for make in ENGINES.values()]
    for each in arms:
        each.reset(np.arange(count), links)
    seen = drive(arms, rng, 200, links, fast=config.max_joint_rate)
    assert ((seen < JOINT_LOW) | (seen > JOINT_HIGH)).any(axis=(0, 1)).all()
    assert arms[0].tool_gap() == pytest.approx(arms[1].tool_gap(), rel=1e-6, abs=1e-12)


@pytest.mark.slow
def test_engines_agree_over_a_million_steps() -> None:
    """All settings, 1.25 million arm steps."""
    for seed, settings in enumerate(SETTINGS):
        config, rng, count = ServoConfig(**settings), np.random.default_rng(seed), 250
        links = rng.uniform(0.1, 4.0, (count, 2))
        arms = [make(config, count) for make in ENGINES.values()]
        for each in arms:
            each.reset(np.arange(count), links)
        drive(arms, rng, 1000, links, fast=config.max_joint_rate)


@pytest.mark.parametrize("env_id", SERVO_IDS)
@pytest.mark.parametrize("level", LEVELS)
def test_worlds_agree_to_the_bit(env_id: str, level: int) -> None:
    """Every output of a whole vector environment, over the ends of episodes."""
    small: dict[str, Any] = {"image_size": 32} if env_id == "UncalibServoPixels-v0" else {}
    envs = [gym.make_vec(env_id, num_envs=3, level=level, engine=engine, horizon=40, **small) for engine in ENGINES]
    first = [env.reset(seed=level) for env in envs]
    assert_equal(first[1][0], first[0][0])
    rng = np.random.default_rng(level)
    for _ in range(60):
        actions = np.sign(rng.uniform(-1.5, 1.5, (3, 2))).astype(np.float32) * rng.uniform(0.2, 1.0)
        pymunk, compiled = (env.step(actions) for env in envs)
        for value, expected in zip(compiled, pymunk, strict=True):
            assert_equal(value, expected)


def test_vector_environments_use_the_compiled_engine_where_it_agrees() -> None:
    single, vector = gym.make("UncalibServo-v0"), gym.make_vec("UncalibServo-v0", num_envs=2)
    assert single.unwrapped.engine == "pymunk"  # type: ignore[attr-defined]
    assert vector.unwrapped.engine == ("compiled" if same_bits() else "pymunk")  # type: ignore[attr-defined]
    assert same_bits() or not EQUAL


def test_vector_environments_use_pymunk_where_the_bits_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(CompiledArms):
        def step(self, rates: Array) -> None:
            super().step(rates)
            self.angles += 1e-16

    same_bits.cache_clear()
    monkeypatch.setitem(ENGINES, "compiled", Other)
    try:
        assert gym.make_vec("UncalibServo-v0", num_envs=2).unwrapped.engine == "pymunk"  # type: ignore[attr-defined]
    finally:
        same_bits.cache_clear()


@pytest.mark.parametrize("env_id", SERVO_IDS)
def test_an_unknown_engine_is_refused(env_id: str) -> None:
    with pytest.raises(ValueError, match=r"engine must be one of pymunk, compiled or None, got 'mujoco'"):
        gym.make(env_id, engine="mujoco")
    with pytest.raises(ValueError, match="engine"):
        gym.make_vec(env_id, num_envs=2, engine="mujoco")


@pytest.mark.parametrize("env_id", ["UncalibServo-v0", "PedestrianServo-v0"])
def test_threads_do_not_change_the_bits(env_id: str) -> None:
    count = 3 * LANES + 2
    envs = [gym.make_vec(env_id, num_envs=count, level=4, threads=threads, horizon=20) for threads in (1, 2, 7)]
    for env in envs:
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(25):
        actions = rng.uniform(-1.0, 1.0, (count, 2))
        first, *others = (env.step(actions) for env in envs)
        for other in others:
            for value, expected in zip(other, first, strict=True):
                assert_equal(value, expected)
    copied = copy.deepcopy(envs[2])
    assert_equal(copied.step(actions)[0], envs[2].step(actions)[0])


@pytest.mark.parametrize("threads", [0, -1, 1.5, True, None])
def test_numbers_of_threads_are_checked(threads: Any) -> None:
    with pytest.raises(ValueError, match="threads must be a whole number of at least 1"):
        gym.make_vec("UncalibServo-v0", num_envs=2, threads=threads)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("way", ["deepcopy", "pickle", "state"])
def test_copied_arms_go_on_to_the_bit(engine: str, way: str) -> None:
    """Arms that were started at different times, one of them at the last step."""
    config, rng, count = ServoConfig(), np.random.default_rng(3), LANES + 3
    links = rng.uniform(0.35, 0.65, (count, 2))
    arms = ENGINES[engine](config, count)
    arms.reset(np.arange(count), links)
    drive([arms], rng, 50, links)
    arms.reset(np.array([2]), links[2:3])
    if way == "state":
        other = ENGINES[engine](config, count)
        other.set_state(arms.get_state(), links)
    else:
        other = copy.deepcopy(arms) if way == "deepcopy" else pickle.loads(pickle.dumps(arms))
    np.testing.assert_array_equal(other.angles, arms.angles)
    for step in range(60):
        if step == 30:
            for each in (arms, other):
                each.reset(np.array([1]), links[1:2])
        rates = rng.uniform(-2.0, 2.0, (count, 2))
        arms.step(rates)
        other.step(rates)
        np.testing.assert_array_equal(other.angles, arms.angles)


def test_kept_rates_do_not_grow_without_bound() -> None:
    arms = PymunkArms(ServoConfig(), 2)
    for step in range(5000):
        if step % 100 == 0:
            arms.reset(np.array([0]), np.full((1, 2), 0.5))
        if step % 150 == 0:
            arms.reset(np.array([1]), np.full((1, 2), 0.5))
        arms.step(np.zeros((1, 2)).repeat(2, axis=0))
    assert len(arms._driven) < 1200
    assert len(arms.get_state()["driven"]) <= 150


@pytest.mark.parametrize("engine", ENGINES)
def test_arms_are_not_driven_before_their_reset(engine: str) -> None:
    arms = ENGINES[engine](ServoConfig(), 2)
    arms.reset(np.array([0]), np.full((1, 2), 0.5))
    with pytest.raises(RuntimeError, match=r"arms \[1\] were never reset"):
        arms.step(np.zeros((2, 2)))
