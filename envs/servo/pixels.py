"""The arm servo seen through its camera: images instead of features."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.envs.servo.env import Observation, UncalibServoEnv, feature_space
from servotrack.envs.servo.imaging import ImageSensor
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.vector import UncalibServoVectorEnv

IMAGE_SIZES = (32, 480)
IMAGE_NOISES = (0.0, 50.0)


class UncalibServoPixelsEnv(UncalibServoEnv):
    """An arm with a camera that nobody calibrated follows a moving target, and all it gets is the image.

    ## Description

    The world of `UncalibServo-v0`, before anybody has extracted features. The camera sees a concrete floor, the
    target's marker, a red disc of 25 mm radius in a white ring, and a distractor's, the same in blue, which rests or
    circles slowly near the target's path. The whole camera model shapes the image: tilt, distortion, aspect,
    vignetting, and black where the lens shows no floor. A rolling shutter exposes every image row at its own instant.
    A lost frame leaves the old image with its old stamp.

    `pixel_noise`, `noise_kind` and the outliers of a level belong to features and leave images as they are; the
    image's own noise is `image_noise`.

    ## Action Space

    As `UncalibServo-v0`.

    ## Observation Space

    A `Dict`:

    | key | shape | type | unit | meaning |
    |---|---|---|---|---|
    | `image` | (S, S, 3) | uint8 | gray levels | RGB image of the newest frame that arrived; S is `image_size` |
    | `joint_angles` | (2,) | float64 | rad | encoder readings at `time` |
    | `goal` | (2,) | float64 | px | column and row at which the target is wanted; pixel k spans k to k + 1 |
    | `frame_time` | (1,) | float64 | s | when its middle row was taken, or when it arrived if `stamped` is false |
    | `time` | (1,) | float64 | s | now; the warm-up lies before 0, scoring starts after 0 |

    ## Rewards

    As `UncalibServo-v0`. `info` too; its `feature_error` counts the camera's own pixels, `camera_size` to a side.

    ## Starting State

    As `UncalibServo-v0`; floor, distractor and image noise are drawn from streams of their own, so that one seed
    means the same arm, camera and target in both worlds.

    ## Episode End

    As `UncalibServo-v0`.

    ## Arguments

    `image_size`: width and height of the image, 32 to 480 px (default 96). `image_noise`: standard deviation of the
    noise on each pixel and channel, 0 to 50 gray levels (default 3). All others as `UncalibServo-v0`.

    ## References

    Zhang Ying-bo, "Unscented Kalman filter for on-line estimation of Jacobian matrix", Journal of Computer Applications
    31(6), 2011, pp. 1699-1702, for the arm and its camera; the images are this package's own.

    ## Version History

    * v0: initial version
    """

    def __init__(
        self,
        level: int = 3,
        *,
        image_size: int = 96,
        image_noise: float = 3.0,
        render_mode: str | None = None,
        **axes: Any,
    ) -> None:
        self.image_size, self.image_noise = check_image_arguments(image_size, image_noise)
        super().__init__(level, render_mode=render_mode, **axes)
        self._sensor = ImageSensor(self.world, self.image_size, self.image_noise)

    def _observation_space(self) -> gym.spaces.Dict:
        return pixel_space(self.config, self.image_size)

    def _observe(self) -> Observation:
        self._sensor.update()
        world, sensor = self.world, self._sensor
        return {
            "image": sensor.images[0].copy(),
            "joint_angles": world.joint_angles[0].copy(),
            "goal": sensor.goal[0].copy(),
            "frame_time": sensor.frame_time[:1].copy(),
            "time": world.time[:1].copy(),
        }

    def _pictured(self) -> dict[str, Any]:
        return {"camera_image": self._sensor.images[0], "distractor": self._sensor.distractor(0)}


class UncalibServoPixelsVectorEnv(UncalibServoVectorEnv):
    """`UncalibServoPixels-v0`, N at a time: what `gym.make_vec("UncalibServoPixels-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of arms N.
        level: As in `UncalibServoEnv`.
        image_size: As in `UncalibServoPixelsEnv`.
        image_noise: As in `UncalibServoPixelsEnv`.
        **arguments: As in `UncalibServoVectorEnv`.
    """

    def __init__(
        self, num_envs: int = 1, level: int = 3, *, image_size: int = 96, image_noise: float = 3.0, **arguments: Any
    ) -> None:
        self.image_size, self.image_noise = check_image_arguments(image_size, image_noise)
        super().__init__(num_envs, level, **arguments)
        self._sensor = ImageSensor(self.world, self.image_size, self.image_noise)

    def _single_observation_space(self) -> gym.spaces.Dict:
        return pixel_space(self.config, self.image_size)

    def _observe(self) -> Observation:
        self._sensor.update()
        world, sensor = self.world, self._sensor
        return {
            "image": sensor.images.copy(),
            "joint_angles": world.joint_angles.copy(),
            "goal": sensor.goal.copy(),
            "frame_time": sensor.frame_time[:, None].copy(),
            "time": world.time[:, None].copy(),
        }

    def _pictured(self, row: int) -> dict[str, Any]:
        return {"camera_image": self._sensor.images[row], "distractor": self._sensor.distractor(row)}


def pixel_space(config: ServoConfig, image_size: int) -> gym.spaces.Dict:
    """Observation space of the pixel worlds; every bound is finite."""
    features = feature_space(config)
    return gym.spaces.Dict(
        {
            "image": gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
            "joint_angles": features["joint_angles"],
            "goal": gym.spaces.Box(0.0, image_size, (2,), np.float64),
            "frame_time": features["frame_time"],
            "time": features["time"],
        }
    )


def check_image_arguments(image_size: int, image_noise: float) -> tuple[int, float]:
    """Size and noise of images, if they can be; raises ValueError that names the argument and its bounds otherwise."""
    low, high = IMAGE_SIZES
    if isinstance(image_size, bool) or not isinstance(image_size, (int, np.integer)) or not low <= image_size <= high:
        raise ValueError(f"image_size must be a whole number of {low} to {high} px, got {image_size!r}")
    quiet, loud = IMAGE_NOISES
    if isinstance(image_noise, bool) or not isinstance(image_noise, (int, float)) or not quiet <= image_noise <= loud:
        raise ValueError(f"image_noise must lie between {quiet} and {loud} gray levels, got {image_noise!r}")
    return int(image_size), float(image_noise)
