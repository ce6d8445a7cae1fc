"""What an agent of the following world sees: the camera's frame, detections in it, or the person's features."""

from __future__ import annotations

from typing import Literal, get_args

import gymnasium as gym
import numpy as np

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.detections import COLUMNS, LARGEST, DetectionSensor, capacity
from servotrack.envs.follow.imaging import PATCH_SIZE, CrowdCamera, target_patches
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.env import Observation, feature_observations, feature_space
from servotrack.envs.servo.pixels import check_image_arguments
from servotrack.estimators.types import Array

ObservationKind = Literal["pixels", "detections", "identity"]


def check_observation(observation: str) -> ObservationKind:
    """The kind of observation, if there is one of that name; raises ValueError that names them otherwise."""
    if observation not in get_args(ObservationKind):
        raise ValueError(f"observation must be one of {', '.join(get_args(ObservationKind))}, got {observation!r}")
    return observation  # type: ignore[return-value]


class FollowSensors:
    """The sensors of N arms; observations have a leading axis of N.

    Args:
        world: The world, which the sensors only read.
        observation: "pixels", "detections" or "identity".
        image_size: Width and height of images, px.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.

    Attributes:
        detector: Also the source of what oracles are told.
        camera: None where nobody sees pixels.

    Raises:
        ValueError: No such observation, or images that cannot be.
    """

    def __init__(self, world: FollowWorld, observation: str, image_size: int, image_noise: float) -> None:
        self.world, self.observation = world, check_observation(observation)
        self.image_size, self.image_noise = check_image_arguments(image_size, image_noise)
        self.detector = DetectionSensor(world)
        self.camera: CrowdCamera | None = None
        self._patches = np.zeros((world.count, PATCH_SIZE, PATCH_SIZE, 3), np.uint8)
        if self.observation == "pixels":
            self.camera = CrowdCamera(world, self.image_size, self.image_noise)

    def space(self) -> gym.spaces.Dict:
        """Of one arm's observations; every bound is finite."""
        config: FollowConfig = self.world.config
        servo = feature_space(config)
        if self.observation == "identity":
            return servo
        shared = {
            "joint_angles": servo["joint_angles"],
            "frame_time": servo["frame_time"],
            "time": servo["time"],
            "target_patch": gym.spaces.Box(0, 255, (PATCH_SIZE, PATCH_SIZE, 3), np.uint8),
        }
        size = float(config.camera_size if self.camera is None else self.image_size)
        shared["target_box"] = gym.spaces.Box(-LARGEST * size, LARGEST * size, (4,), np.float64)
        if self.camera is not None:
            image = gym.spaces.Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
            return gym.spaces.Dict({"image": image, "goal": gym.spaces.Box(0.0, size, (2,), np.float64), **shared})
        high = np.array([1.0, size, size, LARGEST * size, LARGEST * size, 255.0, 255.0, 255.0])
        table = np.tile(high, (capacity(config), 1))
        detections = gym.spaces.Box(np.zeros((len(table), COLUMNS)), table, dtype=np.float64)
        return gym.spaces.Dict({"detections": detections, "goal": servo["goal"], **shared})

    def observe(self) -> Observation:
        """The newest sample of all rows, fresh arrays."""
        world, detector = self.world, self.detector
        if self.observation == "identity":
            return feature_observations(world)
        fresh = detector.update()
        if fresh:
            self._patches[fresh] = target_patches(world, fresh, self.image_noise)
        shared: Observation = {
            "joint_angles": world.joint_angles.copy(),
            "time": world.time[:, None].copy(),
            "target_patch": self._patches.copy(),
        }
        if self.camera is None:
            return {
                "detections": detector.detections.copy(),
                "goal": world.goal.copy(),
                "frame_time": detector.frame_time[:, None].copy(),
                "target_box": detector.target_box.copy(),
                **shared,
            }
        self.camera.update()
        return {
            "image": self.camera.images.copy(),
            "goal": self.camera.goal.copy(),
            "frame_time": self.camera.frame_time[:, None].copy(),
            "target_box": detector.target_box * (self.image_size / world.config.camera_size),
            **shared,
        }

    def privileged(self) -> dict[str, Array]:
        """What an oracle may know beside the servo's own secrets, in the camera's pixels whatever the image's size.

        Returns:
            `true_people` (N, P, 8): everybody in the newest frame as a perfect detector would tell, existence 0 for who
            is hidden, zeros for who is out of view; the first is the person to follow.
        """
        self.detector.update()
        return {"true_people": self.detector.truth.copy()}
