"""A servo that is given images: a marker detector in front of a servo that is given features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.servo import JacobianServo
from servotrack.estimators.detect import MarkerDetector
from servotrack.estimators.jacobian.contract import Array
from servotrack.estimators.jacobian.controller import ControllerState

PIXEL_KEYS = ("image", "joint_angles", "goal", "frame_time", "time")
REFERENCE_SIZE = 480.0
"""Width of the image that features are rescaled to, px."""


class PixelServoState(NamedTuple):
    """State of `PixelServo`.

    Attributes:
        features: Where the marker was last seen. Shape (*batch, 2), px of `REFERENCE_SIZE`.
        frame_time: When that was. Shape (*batch, 1), s; -inf before.
        servo: State of the servo behind.
    """

    features: Array
    frame_time: Array
    servo: ControllerState


class PixelServo:
    """A marker detector in front of a `JacobianServo`: images in, fractions of the joint rate limit out.

    Features are rescaled to an image of `REFERENCE_SIZE`, the unit that the estimators' noise parameters are given in.

    Args:
        servo: What acts on the features.
        detector: Finds them.
    """

    def __init__(self, servo: JacobianServo, detector: MarkerDetector | None = None) -> None:
        self.servo = servo
        self.detector = detector or MarkerDetector()

    def predict(
        self,
        observation: Mapping[str, Any],
        state: PixelServoState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PixelServoState]:
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
        missing = [key for key in PIXEL_KEYS if key not in observation]
        if missing:
            raise ValueError(f"observation must have {', '.join(PIXEL_KEYS)}; {', '.join(missing)} missing")
        scale = REFERENCE_SIZE / np.shape(observation["image"])[-2]
        found, seen = self.detector.detect(observation["image"])
        goal = scale * np.asarray(observation["goal"], dtype=np.float64)
        stamp = np.asarray(observation["frame_time"], dtype=np.float64)
        last_features, last_stamp = goal, np.full_like(stamp, -np.inf)
        if state is not None:
            starts = np.broadcast_to(np.asarray(False if episode_start is None else episode_start), stamp.shape[:-1])
            last_features = np.where(starts[..., None], goal, state.features)
            last_stamp = np.where(starts[..., None], -np.inf, state.frame_time)
        # A lost frame leaves the old image with its old stamp.
        new = seen[..., None] & (stamp > last_stamp)
        features = np.where(new, scale * found, last_features)
        frame_time = np.where(new, stamp, last_stamp)
        seen_features = {
            **{key: value for key, value in observation.items() if key != "image"},
            "features": features,
            "goal": goal,
            "visible": new.astype(np.float64),
            "frame_time": np.where(np.isfinite(frame_time), frame_time, stamp),
        }
        action, servo_state = self.servo.predict(seen_features, None if state is None else state.servo, episode_start)
        return action, PixelServoState(features, frame_time, servo_state)
