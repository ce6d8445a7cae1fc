"""The marker detector: accuracy on painted discs and on the servo world's images, and its refusals."""

import numpy as np
import pytest

from servotrack.envs.servo.imaging import ImageSensor
from servotrack.envs.servo.levels import servo_config
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.detect import MarkerDetector

RED, BLUE = (222.0, 64.0, 38.0), (46.0, 98.0, 196.0)


def painted(center, radius=3.0, color=RED, size=64, background=120.0, fine=8):
    """A disc on gray, each pixel the mean of fine x fine samples."""
    place = (np.arange(size * fine) + 0.5) / fine
    inside = (place[None, :] - center[0]) ** 2 + (place[:, None] - center[1]) ** 2 < radius**2
    share = inside.reshape(size, fine, size, fine).mean(axis=(1, 3))[..., None]
    return np.rint(background + share * (np.asarray(color) - background)).astype(np.uint8)


@pytest.mark.parametrize("radius", [1.2, 2.5, 6.0])
@pytest.mark.parametrize("color", [RED, BLUE, (40.0, 190.0, 60.0)])
def test_painted_disc_is_found_to_hundredths_of_a_pixel(radius, color):
    rng = np.random.default_rng(0)
    for center in rng.uniform(12, 52, (20, 2)):
        found, seen = MarkerDetector(color=color).detect(painted(center, radius, color))
        assert seen
        np.testing.assert_allclose(found, center, atol=0.05)


def test_batches_of_any_shape_equal_single_images():
    images = np.stack([painted((20 + k, 30 - k)) for k in range(6)]).reshape(2, 3, 64, 64, 3)
    centers, seen = MarkerDetector().detect(images)
    assert centers.shape == (2, 3, 2)
    assert seen.shape == (2, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(MarkerDetector().detect(images[index])[0], centers[index])


def test_other_hues_and_gray_are_not_the_marker():
    white = painted((30, 30), color=(250.0, 250.0, 250.0))
    blue = painted((30, 30), color=BLUE)
    centers, seen = MarkerDetector().detect(np.stack([white, blue, np.zeros_like(white)]))
    assert not seen.any()
    np.testing.assert_array_equal(centers, 0.0)


def test_the_larger_of_two_blobs_wins():
    image = np.maximum(painted((20, 20), radius=2.0, background=0), painted((45, 40), radius=4.0, background=0))
    found, seen = MarkerDetector().detect(image)
    assert seen
    np.testing.assert_allclose(found, (45, 40), atol=0.05)


@pytest.mark.parametrize("level", [0, 3, 5])
def test_accuracy_on_the_servo_world_s_images(level):
    config = servo_config(level, pixel_noise=0.0)
    world = ServoWorld(config, 40)
    world.reset(range(40), range(100_000, 100_040))
    sensor, detector = ImageSensor(world, 96, 3.0), MarkerDetector()
    rng = np.random.default_rng(0)
    errors, missed, possible = [], 0, 0
    for _ in range(8):
        sensor.update()
        found, seen = detector.detect(sensor.images)
        truth = world.features * 96 / 480
        inside = (world.visible > 0) & (truth > 4).all(axis=1) & (truth < 92).all(axis=1)
        possible, missed = possible + inside.sum(), missed + (inside & ~seen).sum()
        errors.append(np.hypot(*(found - truth)[inside & seen].T))
        world.step(rng.uniform(-0.5, 0.5, (40, 2)))
    distances = np.concatenate(errors)
    assert possible > 200
    assert missed <= 0.01 * possible
    assert np.median(distances) < 0.15
    assert np.quantile(distances, 0.95) < 0.3


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (np.zeros((8, 8, 3)), "uint8"),
        (np.zeros((8, 8), np.uint8), "shape"),
        (np.zeros((8, 8, 4), np.uint8), "shape"),
        (np.zeros((0, 8, 3), np.uint8), "shape"),
    ],
)
def test_wrong_images_are_refused(images, message):
    with pytest.raises(ValueError, match=message):
        MarkerDetector().detect(images)


@pytest.mark.parametrize(
    "arguments",
    [{"color": (100.0, 100.0, 101.0)}, {"threshold": 0.0}, {"threshold": 1.5}, {"least_weight": 0.0}, {"tint": -1.0}],
)
def test_wrong_parameters_are_named(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        MarkerDetector(**arguments)
