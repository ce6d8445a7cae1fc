"""UncalibServoPixels: images agree with the camera model in space and time, and are deterministic."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import servotrack  # noqa: F401
from servotrack.envs.servo.imaging import ImageSensor
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.world import ServoWorld
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.estimators.camera import project_points
from servotrack.estimators.detect import MarkerDetector

ID = "UncalibServoPixels-v0"
ACTIONS = np.random.default_rng(5).uniform(-0.6, 0.6, (40, 2)).astype(np.float32)


def rollout(steps=12, seed=11, **arguments):
    """Observations of one episode under fixed actions."""
    env = gym.make(ID, disable_env_checker=True, **arguments)
    observations = [env.reset(seed=seed)[0]]
    observations += [env.step(action)[0] for action in ACTIONS[:steps]]
    return observations


def redness(image):
    """Sum and centroid of pixels redder than any floor, independent of the package's own detector."""
    excess = image[..., 0].astype(float) - image[..., 1:].max(axis=-1)
    weights = np.where(excess > 50, excess, 0.0)
    rows, columns = np.mgrid[: len(image), : len(image)] + 0.5
    total = weights.sum()
    return total, np.array([(weights * columns).sum(), (weights * rows).sum()]) / max(total, 1e-9)


def test_check_env():
    check_env(gym.make(ID).unwrapped)


@pytest.mark.parametrize("size", [32, 96, 133])
def test_observation_matches_its_space(size):
    for observation in rollout(steps=3, image_size=size):
        assert observation["image"].shape == (size, size, 3)
        assert observation["image"].dtype == np.uint8
        assert gym.make(ID, image_size=size).observation_space.contains(observation)


def test_same_seed_same_bits_and_other_seed_other_image():
    first, second, other = rollout(), rollout(), rollout(seed=12)
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])
    assert (first[0]["image"] != other[0]["image"]).mean() > 0.5


def test_two_sensors_on_one_world_see_the_same():
    world = ServoWorld(servo_config(3), 2)
    world.reset([0, 1], [8, 9])
    sensors = [ImageSensor(world, 96, 3.0) for _ in range(2)]
    for sensor in sensors:
        sensor.update()
    np.testing.assert_array_equal(sensors[0].images, sensors[1].images)
    assert (sensors[0].images[0] != sensors[0].images[1]).any()


def test_observations_are_fresh_arrays():
    env = gym.make(ID, disable_env_checker=True)
    observation, _ = env.reset(seed=0)
    image = observation["image"].copy()
    env.step(np.ones(2, dtype=np.float32))
    np.testing.assert_array_equal(observation["image"], image)


@pytest.mark.parametrize("level", [0, 2, 3])
@pytest.mark.parametrize("size", [96, 240])
def test_marker_appears_where_the_camera_model_projects_it(level, size):
    found = 0
    for seed in range(100_000, 100_012):
        world = ServoWorld(servo_config(level), 1)
        world.reset([0], [seed])
        sensor = ImageSensor(world, size, 0.0)
        sensor.update()
        pixel, _ = project_points(world.cameras, world.links, world.joints, world.target[:, :2])
        expected = pixel[0] * size / 480
        total, center = redness(sensor.images[0])
        # Markers that the border cuts have their centroid elsewhere.
        if (expected > 0.1 * size).all() and (expected < 0.9 * size).all():
            found += 1
            assert total > 0
            np.testing.assert_allclose(center, expected, atol=0.25 * size / 96)
    assert found >= 5


def test_rolling_shutter_moves_the_marker_as_it_moves_the_features():
    config = servo_config(0, rolling_shutter=0.04)
    world = ServoWorld(config, 1)
    world.reset([0], [3])
    sensor = ImageSensor(world, 240, 0.0)
    moved = []
    for _ in range(12):
        world.step(np.array([[0.3, 0.5]]))
        sensor.update()
        now, _ = project_points(world.cameras, world.links, world.joints, world.target[:, :2])
        moved.append(np.abs(world.features[0] - now[0]).max())
        if world.visible[0] and (np.abs(world.features[0] - 240) < 210).all():
            np.testing.assert_allclose(redness(sensor.images[0])[1] * 2, world.features[0], atol=1.0)
    assert max(moved) > 4.0
    assert sensor.frame_time[0] == pytest.approx(world.time[0] - 0.02)


def test_a_late_frame_is_the_earlier_frame():
    prompt, late = rollout(steps=20, level=3), rollout(steps=20, level=3, latency=2)
    for k in range(2, 21):
        np.testing.assert_array_equal(late[k]["image"], prompt[k - 2]["image"])
        assert late[k]["frame_time"] == prompt[k - 2]["frame_time"]
        assert late[k]["time"] == prompt[k]["time"]


def test_a_lost_frame_repeats_the_old_image_with_its_stamp():
    observations = rollout(steps=40, level=3, dropout=0.5)
    repeats = 0
    for before, after in pairwise(observations):
        same = np.array_equal(before["image"], after["image"])
        assert same == (before["frame_time"] == after["frame_time"])
        repeats += same
    assert 8 <= repeats <= 32


def test_without_stamps_the_frame_time_is_that_of_arrival():
    for observation in rollout(steps=10, level=3, latency=2, stamped=False):
        assert observation["frame_time"] == observation["time"]


def test_image_noise_has_the_level_asked_for():
    quiet, noisy = rollout(steps=2, level=0, image_noise=0.0), rollout(steps=2, level=0, image_noise=6.0)
    differences = [b["image"].astype(float) - a["image"] for a, b in zip(quiet, noisy, strict=True)]
    for a, difference in zip(quiet, differences, strict=True):
        lit = (a["image"] > 30) & (a["image"] < 225)
        assert difference[lit].std() == pytest.approx(6.0, rel=0.03)
        assert abs(difference[lit].mean()) < 0.6
    assert (differences[0] != differences[1]).any()


def test_beyond_the_lens_it_is_black_and_inside_it_is_not():
    image = rollout(steps=0, level=0, distortion=-0.25, image_noise=0.0)[0]["image"]
    rows, columns = np.mgrid[:96, :96] + 0.5
    radius = np.hypot(rows - 48, columns - 48) / 48
    # The fold of d (1 + k rho^2) lies at two thirds of sqrt(-1 / 3k) half widths.
    fold = 2 / 3 * np.sqrt(1 / 0.75)
    assert (image[radius > fold + 0.03] == 0).all()
    assert (image[radius < fold - 0.05].max(axis=-1) > 20).all()


def test_feature_and_pixel_worlds_share_arm_camera_and_target():
    pixels, features = gym.make(ID, level=5), gym.make("UncalibServo-v0", level=5)
    pixels.reset(seed=4)
    features.reset(seed=4)
    for action in ACTIONS[:10]:
        ours, theirs = pixels.step(action), features.step(action)
        assert ours[1] == theirs[1]
        np.testing.assert_array_equal(ours[4]["truth"]["target"], theirs[4]["truth"]["target"])
        np.testing.assert_array_equal(ours[0]["joint_angles"], theirs[0]["joint_angles"])
        np.testing.assert_allclose(ours[0]["goal"] * 5, theirs[0]["goal"])


@pytest.mark.parametrize("level", [3, 5, 6])
def test_vector_environment_keeps_the_contract_and_the_single_one_s_bits(level):
    brief = {"level": level, "horizon": 12, "warmup": 0, "steps": 40}
    check_vector_env(ID, **brief)
    check_vector_matches_single(ID, **brief)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image_size": 31}, "image_size must be a whole number of 32 to 480 px, got 31"),
        ({"image_size": 96.5}, "image_size"),
        ({"image_size": True}, "image_size"),
        ({"image_noise": -1.0}, "image_noise must lie between 0.0 and 50.0 gray levels, got -1.0"),
        ({"image_noise": float("nan")}, "image_noise"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **arguments)
    with pytest.raises(ValueError, match=message):
        gym.make_vec(ID, num_envs=2, vectorization_mode="vector_entry_point", **arguments)


def test_detector_is_blind_to_the_distractor():
    seen_without_target = 0
    for seed in range(100_000, 100_030):
        world = ServoWorld(servo_config(3), 1)
        world.reset([0], [seed])
        world.paths[:, :, :2] += 50.0
        sensor = ImageSensor(world, 96, 3.0)
        sensor.update()
        seen_without_target += bool(MarkerDetector().detect(sensor.images)[1][0])
    assert seen_without_target == 0
