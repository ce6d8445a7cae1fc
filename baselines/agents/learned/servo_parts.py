"""Encodings that give a network what a classical servo computes: its action, or what its estimator has identified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from servotrack.baselines.agents.learned.contract import Encoding, PlainAnswers
from servotrack.baselines.agents.servo.jacobian_servo import JacobianServo, servo_measurement
from servotrack.estimators.jacobian.laws import damped_inverse
from servotrack.estimators.types import FloatArray

JACOBIAN_UNIT = 300.0
"""Unit of an identified Jacobian in a row, px/rad and px/s."""
IDENTIFIED_DAMPING = 0.03
"""Singular value, relative to the largest, below which an identified Jacobian's inverse is damped."""


@dataclass(frozen=True)
class _WithServo(PlainAnswers):
    """Another encoding whose rows get further entries from a classical servo.

    Attributes:
        encoding: Encoding of the rows.
        servo: The classical agent.
        appended: Number of further entries for a planar arm.
    """

    encoding: Encoding
    servo: JacobianServo
    appended: ClassVar[int]

    @property
    def size(self) -> int:
        """Length of a row."""
        return self.encoding.size + self.appended


class ResidualMemory(NamedTuple):
    """Memory of `Residual`.

    Attributes:
        own: Memory of the encoding.
        servo: State of the classical servo.
        action: Action of the classical servo. Shape (N, actions).
    """

    own: Any
    servo: Any
    action: FloatArray


@dataclass(frozen=True)
class Residual(_WithServo):
    """Appends a classical servo's action to another encoding's rows; the network's answer is a correction of it."""

    appended = 2

    def initial(self, observation: Any) -> ResidualMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        measurement: Any = servo_measurement(observation)
        action = np.zeros(measurement.joint_angles.shape, np.float32)
        return ResidualMemory(self.encoding.initial(observation), self.servo.controller.initial(measurement), action)

    def step(self, memory: ResidualMemory, observation: Any, action: FloatArray) -> tuple[ResidualMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        classical, servo = self.servo.predict(observation, memory.servo)
        return ResidualMemory(own, servo, classical), np.concatenate([row, classical], axis=1)

    def act(self, memory: ResidualMemory, answer: FloatArray) -> tuple[ResidualMemory, FloatArray]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        return memory, memory.action + answer


class IdentifiedMemory(NamedTuple):
    """Memory of `Identified`.

    Attributes:
        own: Memory of the encoding.
        estimator: State of the Jacobian estimator.
    """

    own: Any
    estimator: Any


@dataclass(frozen=True)
class Identified(_WithServo):
    """Appends what a classical servo's estimator has identified to another encoding's rows.

    These are the error at present (2, hundreds of px), the total image Jacobian (6, in `JACOBIAN_UNIT`), and the action
    that would remove the error in one period (2, clipped to [-2, 2]). The estimator runs online; nothing of it is
    trained. Law, probing and supervisor of the servo are not used: exploration is up to the network.
    """

    appended = 10

    def initial(self, observation: Any) -> IdentifiedMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        measurement: Any = servo_measurement(observation)
        return IdentifiedMemory(
            self.encoding.initial(observation), self.servo.controller.estimator.initial(measurement)
        )

    def step(
        self, memory: IdentifiedMemory, observation: Any, action: FloatArray
    ) -> tuple[IdentifiedMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        own, row = self.encoding.step(memory.own, observation, action)
        controller, measurement = self.servo.controller, servo_measurement(observation)
        state, estimate = controller.estimator.step(memory.estimator, measurement)  # type: ignore[arg-type]
        assert controller.law is not None, "servos of the catalog have a law of their own"
        period, jacobian = controller.law.period, estimate.jacobian
        inverse = damped_inverse(jacobian[..., :-1], IDENTIFIED_DAMPING)
        motion = -np.einsum("...ij,...j->...i", inverse, estimate.predict_error(np.zeros(inverse.shape[:-1]), period))
        found = [
            estimate.error / 100.0,
            jacobian.reshape(len(row), -1) / JACOBIAN_UNIT,
            np.clip(motion / (controller.max_joint_rate * period), -2.0, 2.0),
        ]
        return IdentifiedMemory(own, state), np.concatenate([row, *found], axis=1).astype(np.float32)
