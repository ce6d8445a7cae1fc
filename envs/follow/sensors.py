"""Observations of PedestrianServo: the camera's frame, detections in it, or the person's image features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.detections import COLUMNS, LARGEST_SIZE, DetectionSensor, capacity
from servotrack.envs.follow.imaging import PATCH_SIZE, CrowdCamera, target_patches
from servotrack.envs.follow.world import FollowWorld
from servotrack.envs.servo.env import Observation, feature_observations, feature_space
from servotrack.envs.servo.pixels import check_image_arguments
from servotrack.envs.state import State, Stateful, part, parts_state, put, taken
from servotrack.estimators.types import Array

ObservationKind = Literal["pixels", "detections", "identity"]


def check_observation(observation: str) -> ObservationKind:
    """Return the kind of observation of this name; raises a ValueError with the valid names if there is none."""
    if observation not in get_args(ObservationKind):
        raise ValueError(f"observation must be one of {', '.join(get_args(ObservationKind))}, got {observation!r}")
    return observation  # type: ignore[return-value]


class FollowSensors:
    """Sensors of N arms. Observations have a leading axis of N.

    Args:
        world: World to observe; it is not changed.
        observation: "pixels", "detections" or "identity".
        image_size: Width and height of images, px.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.

    Attributes:
        detector: Person detector; also the source of the oracles' true detections.
        camera: Camera, or None unless `observation` is "pixels".

    Raises:
        ValueError: An unknown `observation`, or an invalid image size or noise.
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
        """Observation space of one arm. All bounds are finite."""
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
        shared["target_box"] = gym.spaces.Box(-LARGEST_SIZE * size, LARGEST_SIZE * size, (4,), np.float64)
        if self.camera is not None:
            image = gym.spaces.Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
            return gym.spaces.Dict({"image": image, "goal": gym.spaces.Box(0.0, size, (2,), np.float64), **shared})
        high = np.array([1.0, size, size, LARGEST_SIZE * size, LARGEST_SIZE * size, 255.0, 255.0, 255.0])
        table = np.tile(high, (capacity(config), 1))
        detections = gym.spaces.Box(np.zeros((len(table), COLUMNS)), table, dtype=np.float64)
        return gym.spaces.Dict({"detections": detections, "goal": servo["goal"], **shared})

    def observe(self) -> Observation:
        """Return the newest observations of all rows, as new arrays."""
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

    def get_state(self) -> State:
        """Return what `set_state` needs: what the sensors show."""
        return taken(self, ("_patches",)) | parts_state(self._parts())

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state, after the world.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        put(self, ("_patches",), state)
        for name, sensor in self._parts().items():
            sensor.set_state(part(state, name))

    def _parts(self) -> dict[str, Stateful]:
        parts: dict[str, Stateful] = {"detector": self.detector}
        return parts if self.camera is None else parts | {"camera": self.camera}

    def privileged(self) -> dict[str, Array]:
        """Observations for oracles, beside those of `ServoWorld.privileged`.

        Returns:
            `true_people` (N, P, 8): detections of a perfect detector in the newest frame, in camera pixels for every
            image size. The first row is the person to follow. Existence is 0 for hidden people; rows of people out of
            view are zeros.
        """
        self.detector.update()
        return {"true_people": self.detector.truth.copy()}
