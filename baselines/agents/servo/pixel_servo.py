"""A servo that is given images: a marker detector in front of a servo that is given features."""

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
"""Width of the image that features are rescaled to, px."""


class MarkerFinder(Protocol):
    """Finds the target's marker in images."""

    def detect(self, images: Any) -> tuple[Array, Mask]:
        """Centers, shape (*batch, 2), px, and whether it is seen, shape (*batch,), in images (*batch, H, W, 3)."""


class SeenMemory(NamedTuple):
    """What is remembered of images.

    Attributes:
        features: Where the marker was last seen. Shape (*batch, 2), px of `REFERENCE_SIZE`.
        frame_time: When that was. Shape (*batch, 1), s; -inf before.
    """

    features: Array
    frame_time: Array


@dataclass(frozen=True)
class MarkerFeatures:
    """Turns images into the features that `UncalibServo-v0` would give.

    Features are rescaled to an image of `REFERENCE_SIZE`, the unit that the estimators' noise parameters are given in.

    Attributes:
        eyes: What finds the marker.
    """

    eyes: MarkerFinder = field(default_factory=MarkerDetector)

    def initial(self, observation: Mapping[str, Any]) -> SeenMemory:
        """Memory before the first image.

        Raises:
            ValueError: A key is missing.
        """
        _check_keys(observation)
        return SeenMemory(_scaled_goal(observation), np.full(np.shape(observation["frame_time"]), -np.inf))

    def step(self, memory: SeenMemory, observation: Mapping[str, Any]) -> tuple[SeenMemory, dict[str, Any]]:
        """Look at an image.

        Args:
            memory: What the last call returned, or `initial`.
            observation: As `UncalibServoPixels-v0` gives it, single or with a leading axis.

        Returns:
            The new memory, and an observation with features in place of the image.

        Raises:
            ValueError: A key is missing.
        """
        _check_keys(observation)
        found, seen = self.eyes.detect(observation["image"])
        stamp = np.asarray(observation["frame_time"], dtype=np.float64)
        # A lost frame leaves the old image with its old stamp.
        new = seen[..., None] & (stamp > memory.frame_time)
        scale = REFERENCE_SIZE / np.shape(observation["image"])[-2]
        memory = SeenMemory(np.where(new, scale * found, memory.features), np.where(new, stamp, memory.frame_time))
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
        seen: Of what turns images into features.
        servo: State of the servo behind.
    """

    seen: SeenMemory
    servo: ControllerState


class PixelServo:
    """A marker detector in front of a `JacobianServo`: images in, fractions of the joint rate limit out.

    Args:
        servo: What acts on the features.
        eyes: Finds the marker.
    """

    def __init__(self, servo: JacobianServo, eyes: MarkerFinder | None = None) -> None:
        self.servo = servo
        self.features = MarkerFeatures(eyes or MarkerDetector())

    def predict(
        self,
        observation: Mapping[str, Any],
        state: PixelServoState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, PixelServoState]:
        """Choose joint rates.

        Args:
            observation: As `UncalibServoPixels-v0` gives it, single or with a leading axis.
            state: What the last call returned; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: These agents always are.

        Returns:
            As `JacobianServo.predict`.

        Raises:
            ValueError: A key is missing or a measurement is bad.
        """
        before = None if state is None else state.seen
        batch = np.shape(observation.get("frame_time", (0.0,)))[:-1]
        memory = remembered(before, episode_start, batch, lambda: self.features.initial(observation))
        memory, features = self.features.step(memory, observation)
        action, servo = self.servo.predict(features, None if state is None else state.servo, episode_start)
        return action, PixelServoState(memory, servo)
