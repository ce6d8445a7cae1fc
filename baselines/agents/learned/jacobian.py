"""Learned Jacobian estimator: a recurrent network maps image motions and arm motions to the total Jacobian."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.card_fields import check_encoding
from servotrack.baselines.agents.learned.servo_encoding import ERROR_UNIT, ServoEncoding, ServoMemory
from servotrack.baselines.agents.servo.catalog import LAWS
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.controller import ServoController
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, FloatArray

ENTRIES = 6
"""Length of the network's answer: two rotated image coordinates by two joints and time."""
JACOBIAN_SCALE = np.array([2.0, 2.0, 1.0])
"""Jacobian entry for an answer of 1, by column, hundreds of px/rad and of px/s."""
DEFAULT_LAW = "pi"
MOTION_SCALE = 10.0
"""Factor of the joint motion between two observations in the encoding's action, 1/rad."""


class LearnedJacobianState(NamedTuple):
    """State of a `LearnedJacobian`.

    Attributes:
        alignment: Encoder history and newest frame.
        encoding: Memory of the encoding.
        network: Memory of the network. Shape (*batch, M).
        joints: Joint angles of the last observation. Shape (*batch, 2), rad.
        rows: Last input of the network. Shape (*batch, size).
    """

    alignment: AlignmentState
    encoding: ServoMemory
    network: FloatArray
    joints: Array
    rows: FloatArray


@dataclass(frozen=True, eq=False)
class LearnedJacobian:
    """A network as a `JacobianEstimator`, for arms with two joints and one image point.

    The network reads the rows of a `ServoEncoding` and answers with the Jacobian in that encoding's coordinates; this
    class rotates it back to image coordinates.

    Args:
        network: Maps rows (N, size) and memory (N, M) to entries (N, 6) and the next memory.
        memory: Size M of the network's memory.
        encoding: Encoding of measurements to rows.
        alignment: Compensates the age of the newest frame.
    """

    network: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    memory: int
    encoding: ServoEncoding
    alignment: Alignment = field(default_factory=Alignment)

    def initial(self, measurement: ServoMeasurement) -> LearnedJacobianState:
        """Return the state before the first step. Raises ValueError as `Alignment` does."""
        single = np.ndim(measurement.time) == 0
        measurement = add_axis(measurement) if single else measurement
        count = len(measurement.time)
        state = LearnedJacobianState(
            self.alignment.initial(measurement),
            self.encoding.initial(_observation(measurement)),
            np.zeros((count, self.memory), np.float32),
            np.array(measurement.joint_angles, np.float64),
            np.zeros((count, self.encoding.size), np.float32),
        )
        return first_row(state) if single else state

    def step(
        self, state: LearnedJacobianState, measurement: ServoMeasurement
    ) -> tuple[LearnedJacobianState, LinearEstimate]:
        """Process one measurement. Raises ValueError as `Alignment.step` does."""
        if np.ndim(measurement.time) == 0:
            state, estimate = self.step(add_axis(state), add_axis(measurement))
            return first_row(state), LinearEstimate(
                estimate.error[0], estimate.jacobian[0], estimate.log_likelihood[0], estimate.nis[0]
            )
        alignment, increment = self.alignment.step(state.alignment, measurement)
        joints = np.asarray(measurement.joint_angles, np.float64)
        motion = np.clip(MOTION_SCALE * (joints - state.joints), -1.0, 1.0).astype(np.float32)
        memory, rows = self.encoding.step(state.encoding, _observation(measurement), motion)
        answer, carried = self.network(rows, state.network)
        entries = JACOBIAN_SCALE * answer.reshape(-1, 2, 3).astype(np.float64)
        jacobian = np.linalg.solve(image_rotation(memory, joints), entries)
        silent = np.zeros(len(joints))
        estimate = present_estimate(alignment.frame_features, jacobian, increment, measurement.goal, silent, silent)
        return LearnedJacobianState(alignment, memory, carried, joints, rows), estimate


def image_rotation(memory: ServoMemory, joints: Array) -> Array:
    """Return the matrix from image coordinates, px, to the encoding's, hundreds of px. Shape (N, 2, 2)."""
    best = memory.turns[..., 3].argmin(axis=1)
    turns = memory.turns[np.arange(len(best)), best]
    angle = joints.sum(axis=-1) - np.arctan2(turns[:, 1], turns[:, 0])
    c, s = np.cos(angle), np.sin(angle)
    # The image's second axis points down.
    return np.stack([np.stack([c, s], -1), np.stack([s, -c], -1)], -2) / ERROR_UNIT


def jacobian_encoding(settings: Mapping[str, Any]) -> tuple[ServoEncoding, str]:
    """Return the encoding and the law that a card or a file of hyper-parameters describes.

    Raises:
        ValueError: An unknown field or law, or a value out of bounds.
    """
    check_encoding(settings)
    given = {key: value for key, value in settings.items() if key != "kind"}
    law = str(given.pop("law", DEFAULT_LAW))
    return ServoEncoding(**given), law


def create_learned_servo(estimator: LearnedJacobian, env: Any, law: str) -> JacobianServo:
    """Create a servo with this estimator and the law, exploratory moves and supervisor of the classical agents.

    Raises:
        ValueError: An environment that the encoding does not support.
    """
    ServoEncoding.check(getattr(env, "single_observation_space", env.observation_space))
    rate = float(public_attribute(env, "max_joint_rate"))
    return JacobianServo(ServoController(estimator, law=LAWS[law](), max_joint_rate=rate))


def _observation(measurement: ServoMeasurement) -> dict[str, NDArray[Any]]:
    """Return a measurement as the observation that `ServoEncoding` reads."""
    return {
        "joint_angles": np.asarray(measurement.joint_angles, np.float64),
        "features": np.asarray(measurement.features, np.float64),
        "goal": np.asarray(measurement.goal, np.float64),
        "visible": np.asarray(measurement.visible, np.float64)[:, None],
        "frame_time": np.asarray(measurement.frame_time, np.float64)[:, None],
        "time": np.asarray(measurement.time, np.float64)[:, None],
    }
