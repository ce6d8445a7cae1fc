"""The faults of sensors and actuators, measured against what their axes say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from servo_history import run, wiggle

from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.levels import reach_config, servo_config
from servotrack.envs.servo.targets import PERIOD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.camera import project_points
from servotrack.estimators.types import Array


def test_pixel_noise_has_its_size_in_every_kind() -> None:
    actions = wiggle(60, 40)
    clean = run(servo_config(1), actions)
    for kind in ("gaussian", "uniform", "laplace"):
        noisy = run(servo_config(1, pixel_noise=2.0, noise_kind=kind), actions)
        noise = (noisy["features"] - run(servo_config(1, pixel_noise=0.0), actions)["features"])[noisy["visible"] > 0]
        assert noise.std() == pytest.approx(2.0, rel=0.04)
        assert abs(noise.mean()) < 0.1
        kurtosis = float(((noise - noise.mean()) ** 4).mean() / noise.var() ** 2)
        low, high = {"gaussian": (2.7, 3.3), "uniform": (1.7, 1.9), "laplace": (4.5, 8.0)}[kind]
        assert low < kurtosis < high
    rounded = run(servo_config(1, noise_kind="quantized"), actions)
    seen = rounded["features"][rounded["visible"] > 0]
    assert (seen % 1.0 == 0.5).all()
    assert np.abs(seen - clean["features"][rounded["visible"] > 0]).max() <= 0.5


def test_outliers_have_their_rate_and_size() -> None:
    actions = wiggle(100, 60)
    plain, with_outliers = (run(servo_config(1, outlier_rate=rate, horizon=100), actions) for rate in (0.0, 0.05))
    both = (plain["visible"] > 0) & (with_outliers["visible"] > 0)
    offset = (with_outliers["features"] - plain["features"])[both]
    # Clipping at the image's border makes a few outliers smaller.
    hit = np.abs(offset).max(axis=1) > 1e-9
    assert hit.mean() == pytest.approx(0.05, abs=0.01)
    assert offset[hit].std() == pytest.approx(30.0, rel=0.12)


def test_a_dropped_frame_repeats_the_last_one_with_its_stamp() -> None:
    actions = wiggle(100, 40)
    plain, lossy = (run(servo_config(1, dropout=rate, horizon=100), actions) for rate in (0.0, 0.2))
    lost = (lossy["visible"] == 0) & (plain["visible"] == 1)
    assert lost[1:].mean() == pytest.approx(0.2, abs=0.02)
    for name in ("features", "frame_time"):
        np.testing.assert_array_equal(lossy[name][1:][lost[1:]], lossy[name][:-1][lost[1:]])
        kept = lossy["visible"] == 1
        np.testing.assert_array_equal(lossy[name][kept], plain[name][kept])


def test_before_the_first_frame_features_are_the_middle_and_old() -> None:
    world = ServoWorld(servo_config(1, dropout=0.9, latency=(1, 1)), 40)
    for first_seed in (0, 100):
        world.reset(range(40), range(first_seed, first_seed + 40))
        nothing = world.visible == 0
        assert nothing.sum() > 25
        assert (world.features[nothing] == 240.0).all()
        assert (world.frame_time[nothing] < world.time[nothing] - PERIOD).all()
        for _ in range(30):
            world.step(np.zeros((40, 2)))
        assert (world.features != 240.0).any(axis=1).sum() > 30


@pytest.mark.parametrize("stamped", [True, False])
def test_latency_delays_frames_and_stamps_tell(stamped: bool) -> None:
    actions = wiggle(40, 20)
    prompt = run(servo_config(1, horizon=40), actions)
    late = run(servo_config(1, horizon=40, latency=(2, 2), stamped=stamped), actions)
    seen = (late["visible"][2:] == 1) & (prompt["visible"][:-2] == 1)
    assert seen.mean() > 0.8
    np.testing.assert_array_equal(late["features"][2:][seen], prompt["features"][:-2][seen])
    age = (late["time"] - late["frame_time"])[2:][seen]
    np.testing.assert_allclose(age, 2 * PERIOD if stamped else 0.0, atol=1e-12)


def test_unknown_latency_is_drawn_evenly() -> None:
    config = servo_config(6, horizon=5)
    ages = np.array([draw_episode(config, seed).latency for seed in range(300)])
    assert set(ages.tolist()) == {0, 1, 2}
    assert (np.bincount(ages) > 70).all()


def test_a_rolling_shutter_sees_each_row_at_its_own_instant() -> None:
    shutter, size = 0.04, 480
    actions = np.full((60, 1, 2), [0.12, -0.1])
    config = servo_config(0, warmup=0, rolling_shutter=shutter)
    history = run(config, actions)
    episode = draw_episode(config, 0)
    checked = 0
    for step in range(2, 60):
        if not history["visible"][step, 0]:
            continue
        now = step * PERIOD

        def row_seen(at: float, step: int = step, now: float = now) -> tuple[Array, float]:
            share = 1.0 - (now - at) / PERIOD
            joints = history["joints"][step - 1, 0] + share * (
                history["joints"][step, 0] - history["joints"][step - 1, 0]
            )
            point = [0.5 + 0.3 * math.cos(at), 0.5 + 0.2 * math.sin(at)]
            pixel = project_points(episode.camera, episode.links, joints, point)[0]
            return pixel, (now - shutter + shutter * pixel[1] / size) - at

        early, late = now - shutter, now
        for _ in range(50):
            middle = 0.5 * (early + late)
            early, late = (middle, late) if row_seen(middle)[1] > 0 else (early, middle)
        np.testing.assert_allclose(history["features"][step, 0], row_seen(early)[0], atol=5e-3)
        assert history["frame_time"][step, 0] == pytest.approx(now - shutter / 2)
        checked += 1
    assert checked > 40
    global_shutter = run(servo_config(0, warmup=0), actions)["features"]
    assert np.abs(history["features"][5:40] - global_shutter[5:40]).max() > 2.0


def test_a_rolling_shutter_does_not_matter_at_rest() -> None:
    still = np.zeros((10, 8, 2))
    rolling, whole = (run(reach_config(3, rolling_shutter=shutter), still)["features"] for shutter in (0.02, 0.0))
    np.testing.assert_allclose(rolling[1:], whole[1:], atol=1e-9)


def test_encoder_noise_has_its_size_and_is_not_in_the_truth() -> None:
    history = run(servo_config(1, encoder_noise=0.002, horizon=100), wiggle(100, 30))
    exact = run(servo_config(1, horizon=100), wiggle(100, 30))
    np.testing.assert_array_equal(history["joints"], exact["joints"])
    np.testing.assert_array_equal(exact["joint_angles"], exact["joints"])
    noise = history["joint_angles"] - history["joints"]
    assert noise.std() == pytest.approx(0.002, rel=0.05)
    assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 0.05


def test_actuators_are_off_by_gain_and_noise() -> None:
    push = np.full((12, 60, 2), [0.3, 0.3])
    exact = run(servo_config(1), push)["joints"]
    gained = run(servo_config(1, actuation_gain=0.2), push)["joints"]
    ratio = (gained[-1] - gained[0]) / (exact[-1] - exact[0])
    assert 0.79 < ratio.min() < 0.85 and 1.15 < ratio.max() < 1.21
    shaken = run(servo_config(1, actuation_noise=0.04), push)["joints"]
    steps = np.diff(shaken - exact, axis=0)[2:]
    assert 0.5 * 0.04 * PERIOD < steps.std() < 1.5 * 0.04 * PERIOD
