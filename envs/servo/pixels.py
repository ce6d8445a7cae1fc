"""The arm servo with camera images instead of features."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from servotrack.envs.servo.env import Observation, UncalibServoEnv, feature_space
from servotrack.envs.servo.imaging import ImageSensor
from servotrack.envs.servo.levels import ServoConfig, refuse_changing_camera
from servotrack.envs.servo.vector import UncalibServoVectorEnv
from servotrack.envs.state import Stateful

IMAGE_SIZES = (32, 480)
"""Smallest and largest image size, px."""
IMAGE_NOISES = (0.0, 50.0)
"""Smallest and largest image noise, gray levels."""


class UncalibServoPixelsEnv(UncalibServoEnv):
    """An arm with an uncalibrated camera follows a moving target by the camera's images.

    ## Description

    The world of `UncalibServo-v0` with images instead of features. The camera sees a concrete floor, the target's
    marker (a red disc of 25 mm radius in a white ring), and the same marker in blue as a distractor, which rests or
    circles slowly near the target's path. Images are rendered with the full camera model: tilt, distortion, aspect and
    vignetting; pixels without floor are black. A rolling shutter exposes every image row at its own instant. A lost
    frame leaves the old image in place, with its old time stamp.

    `pixel_noise`, `noise_kind` and the outliers of a level act only on features. The noise of images is
    `image_noise`.

    ## Action Space

    Same as in `UncalibServo-v0`.

    ## Observation Space

    A `Dict`:

    | key | shape | type | unit | meaning |
    |---|---|---|---|---|
    | `image` | (S, S, 3) | uint8 | gray levels | RGB image of the newest frame that arrived; S is `image_size` |
    | `joint_angles` | (2,) | float64 | rad | encoder readings at `time` |
    | `goal` | (2,) | float64 | px | desired column and row of the target; pixel k spans k to k + 1 |
    | `frame_time` | (1,) | float64 | s | time when its middle row was taken, or it arrived if `stamped` is false |
    | `time` | (1,) | float64 | s | current time; the warm-up is before 0, scoring starts after 0 |

    ## Rewards

    Same as in `UncalibServo-v0`, also `info`. `feature_error` is in camera pixels (`camera_size` to a side), not in
    pixels of `image`.

    ## Starting State

    Same as in `UncalibServo-v0`. Floor, distractor and image noise have their own random streams, so one seed gives the
    same arm, camera and target in both environments.

    ## Episode End

    Same as in `UncalibServo-v0`.

    ## Arguments

    `image_size`: width and height of the image, 32 to 480 px (default 96). `image_noise`: standard deviation of the
    noise on each pixel and channel, 0 to 50 gray levels (default 3). All others as in `UncalibServo-v0`.

    ## References

    Zhang Ying-bo, "Unscented Kalman filter for on-line estimation of Jacobian matrix", Journal of Computer Applications
    31(6), 2011, pp. 1699-1702, for the arm and its camera. The images are this package's own.

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
        refuse_changing_camera(self.config)
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

    def _parts(self) -> dict[str, Stateful]:
        return {**super()._parts(), "sensor": self._sensor}

    def _pictured(self) -> dict[str, Any]:
        return {"camera_image": self._sensor.images[0], "distractor": self._sensor.distractor(0)}


class UncalibServoPixelsVectorEnv(UncalibServoVectorEnv):
    """N `UncalibServoPixels-v0` environments in one, created by `gym.make_vec("UncalibServoPixels-v0", num_envs=N)`.

    Args:
        num_envs: Number of arms N.
        level: Level of difficulty, 0 to 6.
        image_size: Width and height of the image, 32 to 480 px.
        image_noise: Standard deviation of the noise on each pixel and channel, 0 to 50 gray levels.
        **arguments: Arguments of `UncalibServoVectorEnv`.
    """

    def __init__(
        self, num_envs: int = 1, level: int = 3, *, image_size: int = 96, image_noise: float = 3.0, **arguments: Any
    ) -> None:
        self.image_size, self.image_noise = check_image_arguments(image_size, image_noise)
        super().__init__(num_envs, level, **arguments)
        refuse_changing_camera(self.config)
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

    def _parts(self) -> dict[str, Stateful]:
        return {**super()._parts(), "sensor": self._sensor}

    def _pictured(self, row: int) -> dict[str, Any]:
        return {"camera_image": self._sensor.images[row], "distractor": self._sensor.distractor(row)}


def pixel_space(config: ServoConfig, image_size: int) -> gym.spaces.Dict:
    """Observation space of the pixel environments. All bounds are finite."""
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
    """Return size and noise of images; raises a ValueError with the argument and its bounds if they are invalid."""
    low, high = IMAGE_SIZES
    if isinstance(image_size, bool) or not isinstance(image_size, (int, np.integer)) or not low <= image_size <= high:
        raise ValueError(f"image_size must be a whole number of {low} to {high} px, got {image_size!r}")
    quiet, loud = IMAGE_NOISES
    if isinstance(image_noise, bool) or not isinstance(image_noise, (int, float)) or not quiet <= image_noise <= loud:
        raise ValueError(f"image_noise must lie between {quiet} and {loud} gray levels, got {image_noise!r}")
    return int(image_size), float(image_noise)
