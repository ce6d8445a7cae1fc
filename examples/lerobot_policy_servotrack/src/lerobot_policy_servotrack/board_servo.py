"""Servo of a board of ArUco markers: images and joint positions in, set points out, without torch and LeRobot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.jacobian import AdaptiveKalmanJacobian, ServoController, ServoMeasurement

Array = NDArray[np.float64]


@lru_cache(maxsize=8)
def _detector(dictionary: str) -> Any:
    number = getattr(cv2.aruco, dictionary, None)
    if not dictionary.startswith("DICT_") or number is None:
        raise ValueError(
            f"dictionary must be the name of a dictionary in cv2.aruco, such as DICT_4X4_50: {dictionary!r}"
        )
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number), parameters)


def find_corners(image: NDArray[np.uint8], markers: tuple[int, ...], dictionary: str = "DICT_4X4_50") -> Array:
    """Find the corners of markers.

    Args:
        image: RGB image. Shape (H, W, 3).
        markers: Numbers of the k markers.
        dictionary: Name of the markers' dictionary in `cv2.aruco`.

    Returns:
        Four corners per marker, in the order of `markers`; NaN for a marker that is not seen. Shape (4k, 2), px.

    Raises:
        ValueError: An unknown dictionary.
    """
    found, numbers, _ = _detector(dictionary).detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    corners = np.full((len(markers), 4, 2), np.nan)
    for place, number in zip(found, () if numbers is None else numbers.ravel(), strict=True):
        if number in markers:
            corners[markers.index(number)] = place[0]
    return corners.reshape(-1, 2)


class BoardServoState(NamedTuple):
    """State of a `BoardServo`.

    Attributes:
        controller: State of the controller.
        features: Corners where they were last seen. Shape (4k, 2), px.
        set_points: Last set points of the joints. Shape (n,), rad.
        steps: Number of steps so far.
    """

    controller: Any
    features: Array
    set_points: Array
    steps: int


@dataclass(frozen=True)
class BoardServo:
    """Servo that brings the corners of markers to their goal in the image, by set points of position-controlled joints.

    Args:
        goal: Wanted place of each corner, column and row in turn, as `find_corners` orders them. 8k numbers, px.
        markers: Numbers of the k markers.
        dictionary: Name of the markers' dictionary in `cv2.aruco`.
        period: Time between two steps, s.
        camera_age: Age of an image when it is given to `step`, s. Too small a value makes the servo oscillate.
        encoder_step: Step of the joints' encoders, rad. Larger values learn less from small motions.
        max_joint_rate: Largest rate of a joint, rad/s. Larger values arrive sooner and blur more images.
        lead: Largest distance of a set point from the joint's position, rad. Larger values push harder against
            friction, gravity and obstacles.

    Raises:
        ValueError: `goal` and `markers` do not fit, or a number out of range.
    """

    goal: tuple[float, ...]
    markers: tuple[int, ...] = (0, 1, 2, 3)
    dictionary: str = "DICT_4X4_50"
    period: float = 1.0 / 30.0
    camera_age: float = 0.05
    encoder_step: float = 2.0 * np.pi / 4096.0
    max_joint_rate: float = 0.5
    lead: float = 0.2

    def __post_init__(self) -> None:
        if not self.markers or len(set(self.markers)) != len(self.markers):
            raise ValueError(f"markers must be different numbers, at least one, got {self.markers}")
        if len(self.goal) != 8 * len(self.markers) or not np.isfinite(self.goal).all():
            raise ValueError(
                f"goal must hold 8 finite numbers for each of the {len(self.markers)} markers, got {len(self.goal)}; "
                "take them from an image at the wanted pose: python -m lerobot_policy_servotrack IMAGE FOLDER"
            )
        for name in ("period", "max_joint_rate", "lead"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        for name in ("camera_age", "encoder_step"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")
        _detector(self.dictionary)

    @property
    def controller(self) -> ServoController:
        """Controller of the joints."""
        estimator = AdaptiveKalmanJacobian(joint_noise=self.encoder_step)
        return ServoController(estimator, max_joint_rate=self.max_joint_rate, period=self.period)

    def step(
        self, state: BoardServoState | None, image: NDArray[np.uint8], joints: Array
    ) -> tuple[BoardServoState, Array]:
        """Take one step.

        Args:
            state: State after the last step; None before the first one.
            image: Newest RGB image. Shape (H, W, 3).
            joints: Positions of the joints. Shape (n,), rad.

        Returns:
            The new state, and set points for one period. Shape (n,), rad.
        """
        joints = np.asarray(joints, np.float64)
        goal = np.reshape(self.goal, (-1, 2))
        corners = find_corners(image, self.markers, self.dictionary)
        seen = ~np.isnan(corners[:, 0])
        steps = 0 if state is None else state.steps
        features = np.where(seen[:, None], corners, goal if state is None else state.features)
        now = np.array(steps * self.period)
        measurement = ServoMeasurement(
            joint_angles=joints,
            features=features.ravel(),
            goal=goal.ravel(),
            visible=seen,
            frame_time=now - self.camera_age,
            time=now,
            joint_time=now,
        )
        controller = self.controller
        inner = controller.initial(measurement) if state is None else state.controller
        inner, rate = controller.step(inner, measurement)
        before = joints if state is None else state.set_points
        set_points = np.clip(before + self.period * rate, joints - self.lead, joints + self.lead)
        return BoardServoState(inner, features, set_points, steps + 1), set_points
