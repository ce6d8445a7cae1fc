"""Randomness: each quantity has its own stream, independent of the agent's actions."""

from __future__ import annotations

import numpy as np
import pytest
from servo_history import run, wiggle

from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.streams import (
    Streams,
    draw_exponential,
    draw_index,
    draw_laplace,
    draw_normal,
    draw_share,
    episode_seed,
    start_stream,
)
from servotrack.estimators.compilation import njit

TABLES = (
    "links",
    "camera",
    "goal",
    "path",
    "feature_noise",
    "dropped",
    "latency",
    "gain",
    "rate_noise",
    "encoder_noise",
)
NOISY = {
    "pixel_noise": 1.0,
    "dropout": 0.1,
    "latency": (0, 2),
    "actuation_gain": 0.1,
    "actuation_noise": 0.04,
    "encoder_noise": (0.001, 0.002),
}
TOUCHES = {
    "pixel_noise": {"feature_noise"},
    "outlier_rate": {"feature_noise"},
    "dropout": {"dropped"},
    "latency": {"latency"},
    "actuation_gain": {"gain"},
    "actuation_noise": {"rate_noise"},
    "encoder_noise": {"encoder_noise"},
    "rolling_shutter": set(),
    "max_motor_torque": set(),
}
OTHER_VALUE = {
    "pixel_noise": 0.0,
    "outlier_rate": 0.5,
    "dropout": 0.0,
    "latency": (1, 1),
    "actuation_gain": 0.0,
    "actuation_noise": 0.0,
    "encoder_noise": 0.0,
    "rolling_shutter": 0.02,
    "max_motor_torque": 5.0,
}


@pytest.mark.parametrize("axis", TOUCHES)
def test_an_axis_shifts_no_draw_but_its_own(axis: str) -> None:
    base = servo_config(3, **NOISY)
    other = servo_config(3, **(NOISY | {axis: OTHER_VALUE[axis]}))
    changed = set()
    for seed in range(12):
        one, two = draw_episode(base, seed), draw_episode(other, seed)
        changed |= {name for name in TABLES if not np.array_equal(getattr(one, name), getattr(two, name))}
    assert changed == TOUCHES[axis]


def test_pixel_noise_and_outliers_do_not_shift_each_other() -> None:
    def noise(pixel_noise: float, outlier_rate: float) -> np.ndarray:
        config = servo_config(1, pixel_noise=pixel_noise, outlier_rate=outlier_rate)
        return draw_episode(config, 4).feature_noise

    np.testing.assert_allclose(noise(1.0, 0.2) - noise(1.0, 0.0), noise(0.0, 0.2), rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", ["focal", "mounting", "tilt", "aspect", "distortion", "principal_offset"])
def test_an_axis_of_the_camera_shifts_only_draws_that_it_makes_unsolvable(axis: str) -> None:
    base = servo_config(3)
    other = servo_config(3, **{axis: getattr(servo_config(0), axis)})
    same = sum(np.array_equal(draw_episode(base, s).path, draw_episode(other, s).path) for s in range(60))
    assert same >= 45


def test_different_seeds_are_different_episodes() -> None:
    config = servo_config(6)
    episodes = [draw_episode(config, seed) for seed in range(6)]
    for name in ("links", "camera", "path", "feature_noise", "rate_noise", "encoder_noise"):
        tables = {getattr(episode, name).tobytes() for episode in episodes}
        assert len(tables) == len(episodes), name


def test_streams_of_one_seed_are_not_each_other() -> None:
    episode = draw_episode(servo_config(4, pixel_noise=1.0), 3)
    tables = [episode.feature_noise, episode.rate_noise, episode.encoder_noise]
    for i, one in enumerate(tables):
        for other in tables[:i]:
            assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.15


def test_two_agents_on_one_seed_meet_the_same_noise() -> None:
    config = servo_config(5, dropout=0.2)
    one, two = (run(config, wiggle(60, 20, seed=seed)) for seed in (1, 2))
    assert not np.array_equal(one["joints"], two["joints"])
    np.testing.assert_allclose(
        one["joint_angles"] - one["joints"], two["joint_angles"] - two["joints"], rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(one["target"], two["target"])
    clean = servo_config(5, dropout=0.2, pixel_noise=0.0)
    noises = []
    for seed, noisy in ((1, one), (2, two)):
        plain = run(clean, wiggle(60, 20, seed=seed))
        noises.append((noisy["features"] - plain["features"], (noisy["visible"] > 0) & (plain["visible"] > 0)))
    both = noises[0][1] & noises[1][1]
    assert both.mean() > 0.5
    np.testing.assert_allclose(noises[0][0][both], noises[1][0][both], rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1, 2**32, 2**63 - 1, 2**63 + 7, 2**130 + 5])
@pytest.mark.parametrize("key", [(0,), (2007,), (2**32,), (3, 9), (1, 2**40, 7)])
def test_streams_are_those_of_numpys_seed_sequence(seed, key):
    theirs = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
    ours = Streams(seed)[key if len(key) > 1 else key[0]]
    np.testing.assert_array_equal(ours.integers(0, 2**63, 8), theirs.integers(0, 2**63, 8))


@pytest.mark.parametrize("count", [1, 2, 3, 16, 2**31 + 5, 2**32 - 1])
def test_indices_drawn_in_compiled_code_are_the_generators(count):
    generator, state = Streams(2**63 - 7)[4], np.zeros(6, np.uint64)
    start_stream(2**63 - 7, 4, state)
    for draw in range(100):
        # A number of 64 bits gives two indices; shares between them must not disturb the second one.
        if draw % 7 == 3:
            assert draw_share(state) == generator.random()
        else:
            assert draw_index(state, count) == generator.integers(count)


@njit()
def _draw(state, kind, out):
    for i in range(len(out)):
        if kind == 0:
            out[i] = draw_normal(state)
        elif kind == 1:
            out[i] = draw_exponential(state)
        else:
            out[i] = draw_laplace(state, 0.7)


@pytest.mark.parametrize("kind", ["standard_normal", "standard_exponential", "laplace"])
def test_noise_drawn_in_compiled_code_is_the_generators(kind):
    # Enough draws for the tails, which one in four thousand meets.
    state, ours = np.zeros(4, np.uint64), np.empty(1_000_000)
    start_stream(11, 3, state)
    _draw(state, ("standard_normal", "standard_exponential", "laplace").index(kind), ours)
    arguments = (0.0, 0.7) if kind == "laplace" else ()
    np.testing.assert_array_equal(ours, getattr(Streams(11)[3], kind)(*arguments, size=len(ours)))


def test_episodes_have_the_noise_of_numpys_generators():
    axes = {"outlier_rate": 0.1, "occlusion": 0.5, "knock": 0.4, "encoder_age": (0, 3)}
    config = servo_config(6, **axes)
    for seed in (3, 2**63 - 1):
        episode, streams = draw_episode(config, seed), Streams(seed)
        count = len(episode.path)
        gains = streams[Stream.ACTUATION_GAIN].uniform(-config.actuation_gain, config.actuation_gain, 2)
        np.testing.assert_array_equal(episode.gain, 1.0 + gains)
        for index, stream, name, level in (
            (0, Stream.ENCODER_NOISE, "encoder_noise", config.encoder_noise),
            (1, Stream.ACTUATION_NOISE, "rate_noise", config.actuation_noise),
        ):
            sigma = streams[stream].uniform(*level)
            assert episode.noise_levels[index] == sigma
            noise = sigma * streams[stream].standard_normal((count, 2))
            np.testing.assert_array_equal(getattr(episode, name), noise)
        hit = streams[Stream.OUTLIER].random((count, 1)) < config.outlier_rate
        offset = config.outlier_size * streams[Stream.OUTLIER_OFFSET].standard_normal((count, 2))
        noise = config.pixel_noise * streams[Stream.PIXEL_NOISE].standard_normal((count, 2))
        np.testing.assert_array_equal(episode.feature_noise, np.where(hit, offset, 0.0) + noise)
        assert episode.latency == streams[Stream.LATENCY].integers(0, 3)
        assert episode.encoder_age == streams[Stream.ENCODER_AGE].integers(0, 4)
        quarter = config.horizon // 4
        assert episode.knocked_at == LEAD + config.warmup + streams[Stream.KNOCK].integers(quarter, 3 * quarter + 1)
        assert episode.dropped[streams[Stream.DROPOUT].random(count) < config.dropout].all()


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937])
def test_the_next_episodes_seed_is_a_draw_of_the_generator(kind):
    ours, theirs = (np.random.Generator(kind(5)) for _ in range(2))
    for _ in range(50):
        # Half of a number of 64 bits may be left over.
        assert ours.integers(7) == theirs.integers(7)
        assert episode_seed(ours) == theirs.integers(0, 2**63)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match=r"seed must be a non-negative integer, got -1"):
        Streams(-1)
