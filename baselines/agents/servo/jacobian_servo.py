"""Visual servo with an online estimate of the image Jacobian."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.memory import remembered
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.jacobian.controller import ControllerState, ServoController
from servotrack.estimators.jacobian.informed import Geometry
from servotrack.estimators.types import Array, FloatArray, Mask

OBSERVATION_KEYS = ("joint_angles", "features", "goal", "visible", "frame_time", "time")


class PrivilegedMeasurement(NamedTuple):
    """A `ServoMeasurement` with the truth beside it, for anchors.

    Attributes:
        joint_angles, features, goal, visible, frame_time, time: See `ServoMeasurement`.
        geometry: True camera, links and latency.
        true_jacobian: Analytic total Jacobian of the present. Shape (*batch, m, n + 1), px/rad and px/s.
        joint_time: See `ServoMeasurement`.
    """

    joint_angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    time: Array
    geometry: Geometry
    true_jacobian: Array
    joint_time: Array | None = None


def servo_measurement(observation: Mapping[str, Any]) -> ServoMeasurement | PrivilegedMeasurement:
    """Convert a servo observation, single or batched, to a measurement, with the truth if the observation has it.

    Raises:
        ValueError: A missing key.
    """
    missing = [key for key in OBSERVATION_KEYS if not isinstance(observation, Mapping) or key not in observation]
    if missing:
        raise ValueError(
            f"observation must be a servo's dictionary with {', '.join(OBSERVATION_KEYS)}; {', '.join(missing)} missing"
        )
    fields: dict[str, Any] = {key: observation[key] for key in OBSERVATION_KEYS}
    for key in ("frame_time", "time"):
        fields[key] = np.asarray(fields[key])[..., 0]
    visible = np.asarray(fields["visible"]) > 0.5
    # One entry for all features, or one per point.
    fields["visible"] = visible[..., 0] if visible.shape[-1] == 1 else visible
    if "joint_time" in observation:
        fields["joint_time"] = np.asarray(observation["joint_time"])[..., 0]
    if "true_camera" not in observation:
        return ServoMeasurement(**fields)
    geometry = Geometry(
        camera=observation["true_camera"],
        links=observation["true_links"],
        latency=observation["true_latency"][..., 0],
        readout=observation["true_readout"][..., 0],
    )
    return PrivilegedMeasurement(**fields, geometry=geometry, true_jacobian=observation["true_jacobian"])


class JacobianServo:
    """A `ServoController` behind `predict`: observation in, fractions of the joint rate limit out.

    Args:
        controller: Estimator, law, exploratory moves and supervisor.
    """

    def __init__(self, controller: ServoController) -> None:
        self.controller = controller

    def predict(
        self,
        observation: Mapping[str, Any],
        state: ControllerState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, ControllerState]:
        """Choose joint rates.

        Args:
            observation: Observation of `UncalibServo-v0`, single or with a leading axis.
            state: Result of the last call; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the action is always deterministic.

        Returns:
            The action, shape (*batch, n), in [-1, 1], and the new state.

        Raises:
            ValueError: A missing key or an invalid measurement.
        """
        measurement: Any = servo_measurement(observation)
        batch = np.shape(measurement.time)
        state = remembered(state, episode_start, batch, lambda: self.controller.initial(measurement))
        state, rate = self.controller.step(state, measurement)
        return (rate / self.controller.max_joint_rate).astype(np.float32), state
