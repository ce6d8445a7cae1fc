"""Faults of a worn arm (old encoder readings, lag, backlash, occlusions, a knocked camera), and a lens that zooms."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from servo_history import run, wiggle
from test_engines import assert_equal

from servotrack.baselines.leaderboard.servo_bound import steady_bounds
from servotrack.envs.servo.engine import ENGINES
from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.noise import NEVER
from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.servo.world import ServoWorld
from servotrack.envs.wrappers import VectorPrivilegedObservation
from servotrack.estimators.camera import project_points, zoomed_cameras

WORN: dict[str, Any] = {
    "encoder_age": (0, 3),
    "actuator_lag": 0.08,
    "backlash": 0.02,
    "occlusion": 1.0,
    "occlusion_length": (0.2, 0.6),
    "knock": 0.5,
    "zoom": 0.3,
}


def test_old_encoder_readings_are_the_joint_angles_of_earlier_samples() -> None:
    actions = wiggle(30, 8, size=0.8)
    for age in (1, 4):
        history = run(servo_config(1, encoder_age=age, horizon=40, warmup=0), actions)
        np.testing.assert_array_equal(history["joint_angles"][age:], history["joints"][:-age])
        np.testing.assert_array_equal(history["joint_angles"][:age], history["joints"][:1].repeat(age, axis=0))
    ages = [draw_episode(servo_config(1, encoder_age=(0, 2)), seed).encoder_age for seed in range(90)]
    assert (np.bincount(ages) > 20).all()


def test_a_lag_is_that_of_a_first_order_system() -> None:
    # Constant rates: the angle lags behind by rate times (time constant) once the lag has settled.
    actions, lag = np.full((60, 1, 2), [0.2, -0.2]), 0.15
    prompt, late = (run(servo_config(0, warmup=0, actuator_lag=value), actions)["joints"] for value in (0.0, lag))
    # Rates of 0.4 rad/s; held over a period, a lag settles at T / (exp(T / lag) - 1) behind.
    behind = 0.4 * PERIOD / math.expm1(PERIOD / lag)
    np.testing.assert_allclose((prompt - late)[-1, 0], [behind, -behind], rtol=1e-3)
    rates = np.diff(late[:, 0, 0]) / PERIOD
    assert rates[3] / rates[-1] == pytest.approx(1.0 - math.exp(-(3 + 0.8) * PERIOD / lag), abs=0.03)


def test_backlash_is_the_angle_that_is_lost_at_a_reversal() -> None:
    play, way = 0.03, 20
    rates = np.concatenate([np.full(way, 0.25), np.full(way, -0.25), np.full(way, 0.25)])
    actions = np.stack([rates, rates], axis=-1)[:, None]
    config = servo_config(0, warmup=0, backlash=play)
    tight, loose = (run(servo_config(0, warmup=0, backlash=value), actions)["joints"][:, 0] for value in (0.0, play))
    # Half of the play before the first motion, all of it at every reversal.
    np.testing.assert_allclose((tight - loose)[way], 0.5 * play, rtol=5e-3)
    np.testing.assert_allclose((tight - loose)[2 * way], -0.5 * play, rtol=5e-3)
    np.testing.assert_allclose((tight - loose)[3 * way], 0.5 * play, rtol=5e-3)
    still = run(config, np.zeros((10, 1, 2)))["joints"]
    np.testing.assert_array_equal(still, still[:1].repeat(11, axis=0))


def test_occlusions_have_their_rate_and_length_and_the_target_moves_on() -> None:
    config = servo_config(1, occlusion=0.5, occlusion_length=(0.4, 0.4), horizon=1000)
    masks = np.array([draw_episode(config, seed).dropped for seed in range(40)])
    begins = (masks[:, 1:] & ~masks[:, :-1]).sum()
    assert begins / (~masks).sum() / PERIOD == pytest.approx(0.5, rel=0.1)
    assert masks.sum() * PERIOD / begins == pytest.approx(0.4, rel=0.05)
    actions = wiggle(60, 10)
    free, hidden = (run(servo_config(1, occlusion=rate, horizon=80), actions) for rate in (0.0, 0.5))
    np.testing.assert_array_equal(free["target"], hidden["target"])
    np.testing.assert_array_equal(free["tracking_error"], hidden["tracking_error"])
    assert 0.0 < (hidden["visible"] < free["visible"]).mean() < 0.5


def test_a_knock_turns_the_camera_once_and_frames_before_it_show_the_old_one() -> None:
    config = servo_config(0, warmup=0, pixel_noise=0.0, knock=0.6, latency=(2, 2), horizon=100, target="paper_point")
    checked = 0
    for seed in range(6):
        episode = draw_episode(config, seed)
        before, after = (math.atan2(camera[6], camera[5]) for camera in (episode.camera, episode.knocked))
        assert 25 <= episode.knocked_at - LEAD <= 75 and 0.0 < abs(after - before) <= 0.6
        knocked = episode.camera.copy()
        knocked[5:7] = math.cos(after), math.sin(after)
        history = run(config, np.full((90, 1, 2), 0.02), [seed])
        for step in range(5, 90):
            if not history["visible"][step, 0]:
                continue
            frame = step - 2
            camera = knocked if frame + LEAD >= episode.knocked_at else episode.camera
            pixel = project_points(camera, episode.links, history["joints"][frame, 0], history["target"][frame, 0, :2])
            np.testing.assert_allclose(history["features"][step, 0], pixel[0], atol=1e-9)
            checked += 1
    assert checked > 200
    assert draw_episode(servo_config(0), 0).knocked_at == NEVER


def test_the_truth_shows_the_camera_after_the_knock() -> None:
    env = VectorPrivilegedObservation(gym.make_vec("UncalibServo-v0", num_envs=2, level=0, knock=0.6, horizon=100))
    first, _ = env.reset(seed=3)
    for _ in range(100):
        last, *_ = env.step(np.zeros((2, 2), np.float32))
    assert (np.abs(last["true_camera"][:, 5:7] - first["true_camera"][:, 5:7]).max(axis=1) > 1e-6).all()


def test_a_zoom_magnifies_about_the_goal() -> None:
    config = servo_config(3, pixel_noise=0.0, zoom=0.4, zoom_period=2.0, latency=(1, 1), horizon=80)
    for seed in range(4):
        episode = draw_episode(config, seed)
        factors = episode.focal_factor
        assert (factors[: LEAD + 1] == 1.0).all()
        assert factors.max() == pytest.approx(1.4) and factors.min() == pytest.approx(1.0 / 1.4)
        # A quarter of a period after the reset the lens is at one end, a period after it where it was.
        assert factors[LEAD + 10] in (pytest.approx(1.4), pytest.approx(1.0 / 1.4))
        assert factors[LEAD + 40] == pytest.approx(1.0)
        history = run(config, wiggle(70, 1), [seed])
        for frame in range(69):
            camera = zoomed_cameras(episode.camera, episode.goal, factors[frame + LEAD])
            assert camera[:2] == pytest.approx(factors[frame + LEAD] * episode.camera[:2])
            joints, target = history["joints"][frame, 0], history["target"][frame, 0, :2]
            tool, _ = project_points(camera, episode.links, joints, history["tool"][frame, 0])
            np.testing.assert_allclose(tool, episode.goal, atol=1e-9)
            if history["visible"][frame + 1, 0]:
                pixel, _ = project_points(camera, episode.links, joints, target)
                np.testing.assert_allclose(history["features"][frame + 1, 0], pixel, atol=1e-9)


def test_the_truth_shows_the_zoomed_camera() -> None:
    world = ServoWorld(servo_config(2, zoom=0.3, knock=0.5), 3)
    world.reset(range(3), range(3))
    for action in wiggle(200, 3):
        world.step(action)
        seen, _ = project_points(world.present_cameras(), world.links, world.joints, world.target[:, :2])
        np.testing.assert_allclose(np.hypot(*(seen - world.goal).T), world.feature_error, rtol=1e-9)


def test_the_bound_knows_the_zoom() -> None:
    seeds = list(range(100_000, 100_008))
    still, zooming = (steady_bounds(servo_config(2, zoom=zoom), seeds).mean() for zoom in (0.0, 0.3))
    assert zooming == pytest.approx(still, rel=0.1) and zooming != still


def test_without_faults_nothing_is_drawn() -> None:
    plain, off = (
        ServoWorld(servo_config(5, **axes), 3)
        for axes in ({}, {"knock": 0.0, "occlusion_length": (1, 2), "zoom_period": 4})
    )
    for world in (plain, off):
        world.reset(range(3), range(3))
        for action in wiggle(40, 3):
            world.step(action)
    np.testing.assert_array_equal(plain._samples, off._samples)


def test_worn_worlds_agree_to_the_bit_with_both_engines() -> None:
    envs = [
        gym.make_vec("UncalibServo-v0", num_envs=3, level=6, engine=engine, horizon=60, **WORN) for engine in ENGINES
    ]
    first = [env.reset(seed=1) for env in envs]
    assert_equal(first[1][0], first[0][0])
    rng = np.random.default_rng(0)
    for _ in range(80):
        actions = np.sign(rng.uniform(-1.5, 1.5, (3, 2))).astype(np.float32) * rng.uniform(0.2, 1.0)
        pymunk, compiled = (env.step(actions) for env in envs)
        for value, expected in zip(compiled, pymunk, strict=True):
            assert_equal(value, expected)


@pytest.mark.parametrize("env_id", ["UncalibServoPixels-v0", "PedestrianServo-v0"])
@pytest.mark.parametrize("name", ["knock", "zoom"])
def test_a_camera_that_renders_does_not_change(env_id: str, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be 0 where images or people are rendered"):
        gym.make(env_id, **{name: 0.1})
    with pytest.raises(ValueError, match=f"{name} must be 0 where images or people are rendered"):
        gym.make_vec(env_id, num_envs=2, **{name: 0.1})


def test_bad_faults_are_named() -> None:
    for axes, message in (
        ({"encoder_age": 1.5}, "encoder_age must be a whole number"),
        ({"encoder_age": (0, 9)}, "encoder_age must lie in"),
        ({"backlash": -0.1}, "backlash must lie in"),
        ({"occlusion_length": 0.0}, "occlusion_length must lie in"),
        ({"zoom": 1.5}, "zoom must lie in"),
        ({"zoom_period": 0.1}, "zoom_period must lie in"),
    ):
        with pytest.raises(ValueError, match=message):
            servo_config(3, **axes)  # type: ignore[arg-type]
