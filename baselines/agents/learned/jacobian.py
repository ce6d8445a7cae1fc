"""A Jacobian estimator that learned: from what the image did when the arm moved to the total Jacobian, same law."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.servo_encoding import PIXELS, ServoEncoding, ServoMemory
from servotrack.baselines.agents.servo.catalog import LAWS
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.controller import ServoController
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, FloatArray

ENTRIES = 6
"""Numbers of the network's answer: two image coordinates, turned, by two joints and time."""
USUAL = np.array([2.0, 2.0, 1.0])
"""What an answer of 1 means in each column, hundreds of px/rad and of px/s."""
DEFAULT_LAW = "pi"
MOTION = 10.0
"""Joint motions between two observations are given to the encoding this much larger, rad."""


class LearnedJacobianState(NamedTuple):
    """State of a `LearnedJacobian`.

    Attributes:
        alignment: Encoder history and newest frame.
        encoding: Of the rows.
        network: What the network carries. Shape (*batch, M).
        joints: Of the last observation. Shape (*batch, 2), rad.
        rows: What the network was given last. Shape (*batch, size).
    """

    alignment: AlignmentState
    encoding: ServoMemory
    network: FloatArray
    joints: Array
    rows: FloatArray


@dataclass(frozen=True, eq=False)
class LearnedJacobian:
    """A network as a `JacobianEstimator`, for arms with two joints and one image point.

    The network sees the rows of a `ServoEncoding` and answers with the Jacobian in that encoding's coordinates, which
    are turned back here.

    Args:
        network: FloatArray (N, size) and memory (N, M) in, entries (N, 6) and the next memory out.
        memory: M.
        encoding: What it reads.
        alignment: Bridges the age of the newest frame.
    """

    network: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    memory: int
    encoding: ServoEncoding
    alignment: Alignment = field(default_factory=Alignment)

    def initial(self, measurement: ServoMeasurement) -> LearnedJacobianState:
        """State before the first step. Raises ValueError as `Alignment` does."""
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
        """Fold one measurement in. Raises ValueError as `Alignment.step` does."""
        if np.ndim(measurement.time) == 0:
            state, estimate = self.step(add_axis(state), add_axis(measurement))
            return first_row(state), LinearEstimate(
                estimate.error[0], estimate.jacobian[0], estimate.log_likelihood[0], estimate.surprise[0]
            )
        alignment, increment = self.alignment.step(state.alignment, measurement)
        joints = np.asarray(measurement.joint_angles, np.float64)
        motion = np.clip(MOTION * (joints - state.joints), -1.0, 1.0).astype(np.float32)
        memory, rows = self.encoding.step(state.encoding, _observation(measurement), motion)
        answer, carried = self.network(rows, state.network)
        entries = USUAL * answer.reshape(-1, 2, 3).astype(np.float64)
        jacobian = np.linalg.solve(turning(memory, joints), entries)
        silent = np.zeros(len(joints))
        estimate = present_estimate(alignment.frame_features, jacobian, increment, measurement.goal, silent, silent)
        return LearnedJacobianState(alignment, memory, carried, joints, rows), estimate


def turning(memory: ServoMemory, joints: Array) -> Array:
    """From image coordinates, px, to those of the encoding at these joint angles, hundreds of px. Shape (N, 2, 2)."""
    best = memory.turns[..., 3].argmin(axis=1)
    turns = memory.turns[np.arange(len(best)), best]
    angle = joints.sum(axis=-1) - np.arctan2(turns[:, 1], turns[:, 0])
    c, s = np.cos(angle), np.sin(angle)
    # The image's second axis runs down.
    return np.stack([np.stack([c, s], -1), np.stack([s, -c], -1)], -2) / PIXELS


def jacobian_encoding(settings: Mapping[str, Any]) -> tuple[ServoEncoding, str]:
    """The encoding of an estimator and its law, of a card or of a file of hyper-parameters.

    Raises:
        ValueError: An unknown keyword or law.
    """
    given = {key: value for key, value in settings.items() if key != "kind"}
    law = str(given.pop("law", DEFAULT_LAW))
    if law not in LAWS:
        raise ValueError(f"law must be one of {', '.join(LAWS)}, got {law!r}")
    try:
        return ServoEncoding(**given), law
    except TypeError as error:
        raise ValueError(f"encoding jacobian takes kind, law, lags, ages, got {dict(settings)!r}") from error


def create_learned_servo(estimator: LearnedJacobian, env: Any, law: str) -> JacobianServo:
    """The estimator behind the same law, exploratory moves and supervisor as the classical ones.

    Raises:
        ValueError: No servo that the encoding can read.
    """
    ServoEncoding.check(getattr(env, "single_observation_space", env.observation_space))
    rate = float(public_attribute(env, "max_joint_rate"))
    return JacobianServo(ServoController(estimator, law=LAWS[law](), max_joint_rate=rate))


def _observation(measurement: ServoMeasurement) -> dict[str, NDArray[Any]]:
    """As `ServoEncoding` reads it."""
    return {
        "joint_angles": np.asarray(measurement.joint_angles, np.float64),
        "features": np.asarray(measurement.features, np.float64),
        "goal": np.asarray(measurement.goal, np.float64),
        "visible": np.asarray(measurement.visible, np.float64)[:, None],
        "frame_time": np.asarray(measurement.frame_time, np.float64)[:, None],
        "time": np.asarray(measurement.time, np.float64)[:, None],
    }
