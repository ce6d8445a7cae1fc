"""Configuration of the policy type `servotrack`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType
from lerobot.optim.optimizers import AdamWConfig

from lerobot_policy_servotrack.board_servo import BoardServo


@PreTrainedConfig.register_subclass("servotrack")
@dataclass
class ServotrackConfig(PreTrainedConfig):
    """Policy that moves the arm until a board of ArUco markers is at its place in the image. Nothing is trained.

    The state must hold joint positions, the action their set points, in the same units and order. Joints beyond the
    first `joints` ones, such as a gripper, are held where they are at the first step.

    Attributes:
        goal: Wanted place of each corner, column and row in turn: 8 numbers per marker, px. See `BoardServo`.
        markers: Numbers of the board's markers.
        dictionary: Name of the markers' dictionary in `cv2.aruco`.
        camera: Key of the camera's image; empty: the only one.
        joints: Number of joints that the policy moves, from the first on.
        units_per_radian: Units of state and action in one radian: 57.3 for degrees.
        fps: Rate at which the policy is called, Hz. It must be the rate of the robot's control loop.
        camera_age: Age of an image when the policy gets it, s.
        encoder_step: Step of the joints' encoders, rad.
        max_joint_rate: Largest rate of a joint, rad/s.
        lead: Largest distance of a set point from the joint's position, rad.
    """

    goal: list[float] = field(default_factory=list)
    markers: list[int] = field(default_factory=lambda: [0, 1, 2, 3])
    dictionary: str = "DICT_4X4_50"
    camera: str = ""
    joints: int = 5
    units_per_radian: float = 180.0 / math.pi
    fps: float = 30.0
    camera_age: float = 0.05
    encoder_step: float = 2.0 * math.pi / 4096.0
    max_joint_rate: float = 0.5
    lead: float = 0.2

    def servo(self) -> BoardServo:
        """Return the servo. Raises ValueError for settings out of range."""
        if not 0.0 < self.fps < math.inf:
            raise ValueError(f"fps must be finite and > 0 Hz, got {self.fps}")
        return BoardServo(
            goal=tuple(self.goal),
            markers=tuple(self.markers),
            dictionary=self.dictionary,
            period=1.0 / self.fps,
            camera_age=self.camera_age,
            encoder_step=self.encoder_step,
            max_joint_rate=self.max_joint_rate,
            lead=self.lead,
        )

    @property
    def camera_key(self) -> str:
        """Key of the image in an observation."""
        if self.camera:
            return self.camera
        keys = list(self.image_features)
        if len(keys) != 1:
            raise ValueError(f"camera must name one of the images {keys}, because there is not exactly one")
        return keys[0]

    def validate_features(self) -> None:
        """Raise ValueError unless there are an image, and joint positions for state and action."""
        inputs = {} if self.input_features is None else self.input_features
        image = inputs.get(self.camera_key)
        if image is None or image.type is not FeatureType.VISUAL:
            raise ValueError(f"camera must name an image among the input features {list(inputs)}, got {self.camera!r}")
        for name, feature in (("state", self.robot_state_feature), ("action", self.action_feature)):
            if feature is None or len(feature.shape) != 1 or feature.shape[0] < self.joints:
                shape = None if feature is None else feature.shape
                raise ValueError(f"the {name} must hold at least joints={self.joints} positions, got shape {shape}")

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return an optimizer, which LeRobot expects; there is nothing to optimize."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> None:
        """Return None: there is nothing to schedule."""

    @property
    def observation_delta_indices(self) -> None:
        """None: the newest observation only."""

    @property
    def action_delta_indices(self) -> None:
        """None: one action at a time."""

    @property
    def reward_delta_indices(self) -> None:
        """None: no rewards."""
