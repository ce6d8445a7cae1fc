"""Exact states of all environments: taken, stored, set, copied and pickled, they go on to the bit."""

from __future__ import annotations

import copy
import io
import os
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import servotrack  # noqa: F401
from servotrack.envs.registration import ENVIRONMENTS
from servotrack.envs.state import State

STATES = int(os.environ.get("SERVOTRACK_FUZZED_STATES", "15"))
"""Number of damaged states of each environment."""
SMALL: dict[str, dict[str, Any]] = {
    "UncalibServo-v0": {
        "level": 4,
        "horizon": 30,
        "latency": (0, 2),
        "backlash": 0.01,
        "actuator_lag": 0.1,
        "knock": 1.0,
        "zoom": 0.3,
    },
    "UncalibServoReach-v0": {"level": 6, "horizon": 30},
    "UncalibServoPixels-v0": {"level": 5, "image_size": 32, "horizon": 30, "dropout": 0.5},
    "UncalibServo3D-v0": {"level": 5, "horizon": 30},
    "PedestrianServo-v0": {"level": 6, "horizon": 30},
    "ClutterTracking-v0": {"level": 1, "horizon": 30},
    "RecordedPoints-v0": {"horizon": 30, "lag": 2},
    "PedestrianTracking-v0": {"horizon": 30, "observation": "blobs", "width": 192, "height": 144},
    "ColorTracking-v0": {"horizon": 30},
    "SonarTracking-v0": {"level": 1, "horizon": 30},
    "VideoTracking-v0": {"horizon": 30},
}
assert SMALL.keys() == ENVIRONMENTS.keys()
CASES = [(env_id, {}) for env_id in SMALL] + [
    ("UncalibServo-v0", {"engine": "compiled"}),
    ("PedestrianServo-v0", {"engine": "compiled", "observation": "pixels", "image_size": 32}),
    ("PedestrianServo-v0", {"observation": "identity"}),
    ("ClutterTracking-v0", {"level": 0}),
]
each_case = pytest.mark.parametrize(("env_id", "more"), CASES, ids=str)


def made(env_id: str, more: dict[str, Any], count: int = 0, **arguments: Any) -> Any:
    kwargs = SMALL[env_id] | more | arguments
    return gym.make_vec(env_id, num_envs=count, **kwargs) if count else gym.make(env_id, **kwargs).unwrapped


def actions(env: Any, steps: int) -> list[Any]:
    """Random actions; half of the answers' rows are empty."""
    env.action_space.seed(1)
    return [env.action_space.sample() for _ in range(steps)]


def assert_same(value: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert value.keys() == expected.keys()
        for key in expected:
            assert_same(value[key], expected[key])
    elif isinstance(expected, (tuple, list)) or np.asarray(expected).dtype.kind == "O":
        for own, other in zip(value, expected, strict=True):
            assert_same(own, other)
    else:
        np.testing.assert_array_equal(value, expected)


def go_on(env: Any, steps: list[Any]) -> list[Any]:
    """Outputs of the steps, and of the episode after a reset without a seed."""
    outputs: list[Any] = []
    for action in steps:
        outputs.append(env.step(action))
        if not hasattr(env, "num_envs") and (outputs[-1][2] or outputs[-1][3]):
            outputs.append(env.reset())
    outputs.append(env.reset())
    outputs += [env.step(action) for action in steps[:3]]
    return outputs


def stored(state: State) -> State:
    """Write and read a state as a file without objects."""
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as read:
        return dict(read)


@each_case
@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("way", ["state", "elsewhere", "deepcopy", "pickle"])
def test_every_environment_goes_on_to_the_bit(env_id: str, more: dict[str, Any], count: int, way: str) -> None:
    env = made(env_id, more, count)
    steps = actions(env, 24)
    env.reset(seed=5)
    if count:
        for action in steps[:4]:
            env.step(action)
        env.reset(options={"reset_mask": np.arange(count) == 1})
    for action in steps[:9]:
        env.step(action)
    if way in ("state", "elsewhere"):
        state = stored(env.get_state())
        if way == "elsewhere":
            other = made(env_id, more, count)
            if count:
                other.reset(seed=8)
                other.step(steps[0])
            other.set_state(state)
            expected = go_on(env, steps)
        else:
            expected = go_on(env, steps)
            other = env
            other.set_state(state)
    else:
        other = copy.deepcopy(env) if way == "deepcopy" else pickle.loads(pickle.dumps(env))
        expected = go_on(env, steps)
    assert_same(go_on(other, steps), expected)


@pytest.mark.parametrize("env_id", SMALL)
def test_copies_do_not_share_anything(env_id: str) -> None:
    """A copy that goes its own way does not move the original."""
    env, twin = made(env_id, {}), made(env_id, {})
    steps = actions(env, 12)
    for each in (env, twin):
        each.reset(seed=2)
        each.step(steps[0])
    other = copy.deepcopy(env)
    state = env.get_state()
    for action in reversed(steps):
        other.step(action)
    assert_same(go_on(env, steps), go_on(twin, steps))
    twin.set_state(state)
    assert_same(twin.get_state(), state)


@pytest.mark.parametrize("env_id", ["UncalibServo-v0", "PedestrianServo-v0", "UncalibServo3D-v0"])
def test_pictures_of_copies_are_the_same(env_id: str) -> None:
    env = made(env_id, {}, render_mode="rgb_array")
    env.reset(seed=0)
    for action in actions(env, 12):
        env.step(action)
    other = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(other.render(), env.render())


def test_a_state_of_one_scene_fills_a_vector_environment() -> None:
    """As planning needs it: many futures of one present."""
    single = made("UncalibServo-v0", {"engine": "compiled"})
    many = made("UncalibServo-v0", {"engine": "compiled"}, 20)
    steps = actions(single, 10)
    single.reset(seed=3)
    single.step(steps[0])
    many.set_state(single.get_state())
    observation, reward, *_ = single.step(steps[1])
    all_observations, rewards, *_ = many.step(np.tile(steps[1], (20, 1)))
    np.testing.assert_array_equal(rewards, np.full(20, reward))
    for key, value in observation.items():
        np.testing.assert_array_equal(all_observations[key], np.tile(value, (20, 1)))


def test_there_is_no_state_before_the_first_reset() -> None:
    for env in (made("ClutterTracking-v0", {}), made("UncalibServo-v0", {}, 2)):
        with pytest.raises(ResetNeeded, match=r"call reset\(\) before get_state"):
            env.get_state()


FOREIGN = {
    "another id": ("UncalibServoReach-v0", {}, "state is of environment 'UncalibServoReach', this is 'UncalibServo'"),
    "another level": (
        "UncalibServo-v0",
        {"level": 3},
        "configuration: .*target='ellipse' instead of",
    ),
    "another argument": ("UncalibServo-v0", {"pixel_noise": 2.0}, "pixel_noise=2.0 instead of 1.0"),
    "another engine": ("UncalibServo-v0", {"engine": "compiled"}, "engine='compiled' instead of 'pymunk'"),
}


@pytest.mark.parametrize(("env_id", "more", "message"), FOREIGN.values(), ids=FOREIGN)
def test_foreign_states_are_refused_by_name(env_id: str, more: dict[str, Any], message: str) -> None:
    foreign = made(env_id, SMALL["UncalibServo-v0"] | more if env_id == "UncalibServo-v0" else more)
    foreign.reset(seed=0)
    env = made("UncalibServo-v0", {})
    env.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.set_state(foreign.get_state())


DAMAGES: dict[str, tuple[Any, str]] = {
    "no mapping": (lambda state: 3, "must be what get_state"),
    "another format": (lambda state: state | {"format": np.array(99)}, "state is of format 99, this is 1"),
    "a missing entry": (lambda state: {k: v for k, v in state.items() if k != "world/history"}, "lacks 'history'"),
    "another shape": (
        lambda state: state | {"world/history": np.zeros((1, 3, 2))},
        "'history' must be float64",
    ),
    "another type": (lambda state: state | {"world/seeds": np.array([0.5])}, "'seeds' must be int64"),
    "NaN": (lambda state: state | {"world/sample/tool": np.full((1, 2), np.nan)}, "'sample/tool' must be finite"),
    "a step too far": (lambda state: state | {"world/sample/steps": np.array([10_000])}, "steps lie in 0 to 30"),
    "a fault in the last part": (
        lambda state: state | {"world/arms/rates": np.zeros((1, 4, 3))},
        "'rates' must be float64",
    ),
    "a negative seed": (lambda state: state | {"world/seeds": np.array([-4])}, "seeds must be at least 0"),
    "damaged settings": (lambda state: state | {"configuration": np.array("{")}, "'configuration' is damaged"),
    "rates of another arm": (lambda state: state | {"world/arms/driven": np.array([99])}, "'driven' must lie in 0 to"),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_states_are_refused_and_change_nothing(damage: Any, message: str) -> None:
    env, twin = made("UncalibServo-v0", {}), made("UncalibServo-v0", {})
    steps = actions(env, 8)
    for each in (env, twin):
        each.reset(seed=1)
        each.step(steps[0])
    with pytest.raises(ValueError, match=message):
        env.set_state(damage(env.get_state()))
    assert_same(go_on(env, steps), go_on(twin, steps))


def test_a_refused_picture_leaves_the_world_as_it_was() -> None:
    env, twin = made("UncalibServoPixels-v0", {}), made("UncalibServoPixels-v0", {})
    steps = actions(env, 8)
    for each in (env, twin):
        each.reset(seed=1)
        each.step(steps[0])
    other = made("UncalibServoPixels-v0", {})
    other.reset(seed=9)
    with pytest.raises(ValueError, match="'images' must be uint8"):
        env.set_state(other.get_state() | {"sensor/images": np.zeros(4)})
    assert_same(go_on(env, steps), go_on(twin, steps))


NUMBERS = {
    "f": (0.0, -1.0, 1e-300, 1e6, 1e18, 1e300, -1e300),
    "i": (0, 1, -1, 7, 29, 30, 31, 10**6, 2**40, -(2**63), 2**63 - 1),
    "u": (0, 1, 2, 255, 2**40, 2**64 - 1),
    "b": (False, True),
}


def damaged(state: State, rng: np.random.Generator) -> State:
    """Copy of a state in which up to three entries have other numbers."""
    state = dict(state)
    names = [name for name, value in state.items() if value.size and value.dtype.kind in NUMBERS]
    for name in rng.choice(names, rng.integers(1, 4)).tolist():
        value = state[name] = state[name].copy()
        number = NUMBERS[value.dtype.kind][rng.integers(len(NUMBERS[value.dtype.kind]))]
        at = tuple(rng.integers(value.shape)) if rng.random() < 0.7 else ...
        value[at] = number if value.dtype != np.uint8 else number % 256
    return state


@each_case
@pytest.mark.parametrize("count", [0, 2])
def test_states_with_other_numbers_are_refused_or_played(env_id: str, more: dict[str, Any], count: int) -> None:
    """Indices into tables are checked before compiled code follows them."""
    env, rng = made(env_id, more, count), np.random.default_rng(0)
    steps = actions(env, 4)
    env.reset(seed=1)
    for action in steps:
        env.step(action)
    state = env.get_state()
    for _ in range(STATES):
        try:
            env.set_state(damaged(state, rng))
        except ValueError:
            continue
        try:
            for action in steps:
                env.step(action)
        except ResetNeeded:
            continue
    env.set_state(state)


def test_an_episode_that_is_over_cannot_be_set_running() -> None:
    env = made("UncalibServo-v0", {})
    env.reset(seed=0)
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(np.zeros(2))
        over = terminated or truncated
    state = env.get_state()
    assert truncated
    with pytest.raises(ValueError, match="'running' must be False at the last step"):
        env.set_state(state | {"running": np.array([True])})


def test_a_camera_has_no_state(monkeypatch: pytest.MonkeyPatch) -> None:
    env = made("VideoTracking-v0", {})
    env.reset(seed=0)
    object.__setattr__(env.world.config, "source", 0)
    try:
        with pytest.raises(ValueError, match=r"source=0 is a camera"):
            env.get_state()
    finally:
        object.__setattr__(env.world.config, "source", None)
