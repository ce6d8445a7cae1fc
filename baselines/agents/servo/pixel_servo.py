"""Visual servo on images: a marker detector in front of a servo that reads features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.estimators.detect import MarkerDetector
from servotrack.estimators.jacobian.controller import ControllerState
from servotrack.estimators.types import Array, FloatArray, Mask

PIXEL_KEYS = ("image", "joint_angles", "goal", "frame_time", "time")
REFERENCE_SIZE = 480.0
"""Image width that features are rescaled to, px."""


class MarkerFinder(Protocol):
    """Contract of a marker detector."""

    def detect(self, images: Any) -> tuple[Array, Mask]:
        """Return centers, shape (*batch, 2), px, and visibility, shape (*batch,), in images (*batch, H, W, 3)."""


class MarkerMemory(NamedTuple):
    """Newest detection of the marker.

    Attributes:
        features: Position of the marker when last seen. Shape (*batch, 2), px of `REFERENCE_SIZE`.
        frame_time: Time stamp of that frame. Shape (*batch, 1), s; -inf before the first detection.
    """

    features: Array
    frame_time: Array


@dataclass(frozen=True)
class MarkerFeatures:
    """Converts images to the features that `UncalibServo-v0` observes.

    Features are rescaled to an image of `REFERENCE_SIZE`, the unit of the estimators' noise parameters.

    Attributes:
        detector: Finds the marker.
    """

    detector: MarkerFinder = field(default_factory=MarkerDetector)

    def initial(self, observation: Mapping[str, Any]) -> MarkerMemory:
        """Return the memory before the first image.

        Raises:
            ValueError: A key is missing.
        """
        _check_keys(observation)
        return MarkerMemory(_scaled_goal(observation), np.full(np.shape(observation["frame_time"]), -np.inf))

    def step(self, memory: MarkerMemory, observation: Mapping[str, Any]) -> tuple[MarkerMemory, dict[str, Any]]:
        """Process an image.

        Args:
            memory: Result of the last call, or of `initial`.
            observation: Observation of `UncalibServoPixels-v0`, single or with a leading axis.

        Returns:
            The new memory, and an observation with features in place of the image.

        Raises:
            ValueError: A key is missing.
        """
        _check_keys(observation)
        found, seen = self.detector.detect(observation["image"])
        stamp = np.asarray(observation["frame_time"], dtype=np.float64)
        # After a lost frame the observation repeats the old image with its old stamp.
        new = seen[..., None] & (stamp > memory.frame_time)
        scale = REFERENCE_SIZE / np.shape(observation["image"])[-2]
        memory = MarkerMemory(np.where(new, scale * found, memory.features), np.where(new, stamp, memory.frame_time))
        return memory, {
            **{key: value for key, value in observation.items() if key != "image"},
            "features": memory.features,
            "goal": _scaled_goal(observation),
            "visible": new.astype(np.float64),
            "frame_time": np.where(np.isfinite(memory.frame_time), memory.frame_time, stamp),
        }


def _check_keys(observation: Mapping[str, Any]) -> None:
    if missing := [key for key in PIXEL_KEYS if key not in observation]:
        raise ValueError(f"observation must have {', '.join(PIXEL_KEYS)}; {', '.join(missing)} missing")


def _scaled_goal(observation: Mapping[str, Any]) -> Array:
    return REFERENCE_SIZE / np.shape(observation["image"])[-2] * np.asarray(observation["goal"], dtype=np.float64)


class PixelServoState(NamedTuple):
    """State of `PixelServo`.

    Attributes:
        seen: Newest detection of the marker.
        servo: State of the servo.
    """

    seen: MarkerMemory
    servo: ControllerState


class PixelServo:
    """A marker detector in front of a `JacobianServo`: images in, fractions of the joint rate limit out.

    Args:
        servo: Servo that reads the features.
        detector: Finds the marker; None: `MarkerDetector`.
    """

    def __init__(self, servo: JacobianServo, detector: MarkerFinder | None = None) -> None:
        self.servo = servo
        self.features = MarkerFeatures(detector or MarkerDetector())

    def predict(
        self,
        observation: Mapping[str, Any],
        state: PixelServoState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, PixelServoState]:
        """Choose joint rates.

        Args:
            observation: Observation of `UncalibServoPixels-v0`, single or with a leading axis.
            state: Result of the last call; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the action is always deterministic.

        Returns:
            The action and the new state, as `JacobianServo.predict` returns them.

        Raises:
            ValueError: A missing key or an invalid measurement.
        """
        before = None if state is None else state.seen
        batch = np.shape(observation.get("frame_time", (0.0,)))[:-1]
        memory = remembered(before, episode_start, batch, lambda: self.features.initial(observation))
        memory, features = self.features.step(memory, observation)
        action, servo = self.servo.predict(features, None if state is None else state.servo, episode_start)
        return action, PixelServoState(memory, servo)
