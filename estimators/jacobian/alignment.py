"""Pairing of joint motion and feature motion by time stamps.

An increment dy belongs to the dtheta of the same interval: one frame of uncompensated latency breaks every Jacobian
estimator. Therefore the latest encoder readings are kept and interpolated at the frames' instants.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.contract import Increment, LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import first_bad


class AlignmentState(NamedTuple):
    """Encoder history and the newest usable frame.

    Attributes:
        history_time: Instants of the encoder readings, oldest first, -inf before the first one. Shape (*batch, H), s.
        history_angles: Encoder readings. Shape (*batch, H, n), rad.
        seen: True once there has been a usable frame. Shape (*batch,), bool.
        frame_time: Instant of the newest usable frame, latency subtracted. Shape (*batch,), s.
        frame_joints: Joint angles at that instant. Shape (*batch, n), rad.
        frame_features: Features of that frame; the goal before the first usable frame. Shape (*batch, m), px.
    """

    history_time: Array
    history_angles: Array
    seen: Mask
    frame_time: Array
    frame_joints: Array
    frame_features: Array


@dataclass(frozen=True)
class Alignment:
    """Conversion of measurements into increments whose joint and feature parts belong to the same interval.

    A frame is not fresh if it is repeated, does not show the target, goes back in time, or is older than the history.
    After dropped frames the next increment spans the gap. The arm is assumed to be at rest before the first reading.

    Args:
        history: Number H of encoder readings kept, at least 2. It must cover the latency.
        latency: Age of a frame at its stamp, s, subtracted from `frame_time`. Use it for cameras that stamp frames on
            arrival.
    """

    history: int = 16
    latency: float = 0.0

    def __post_init__(self) -> None:
        if self.history < 2:
            raise ValueError(f"history must be at least 2 readings, got {self.history}")
        if not 0.0 <= self.latency < np.inf:
            raise ValueError(f"latency must be finite and >= 0 s, got {self.latency}")

    def initial(self, measurement: ServoMeasurement) -> AlignmentState:
        """State before the first `step`, to which the same measurement must be passed.

        Raises:
            ValueError: As `checked` does.
        """
        measurement = checked(measurement)
        batch, n = measurement.joint_angles.shape[:-1], measurement.joint_angles.shape[-1]
        return AlignmentState(
            history_time=np.full((*batch, self.history), -np.inf),
            history_angles=np.repeat(measurement.joint_angles[..., None, :], self.history, axis=-2).reshape(
                *batch, self.history, n
            ),
            seen=np.zeros(batch, dtype=np.bool_),
            frame_time=measurement.time.copy(),
            frame_joints=measurement.joint_angles.copy(),
            frame_features=measurement.goal.copy(),
        )

    def step(self, state: AlignmentState, measurement: ServoMeasurement) -> tuple[AlignmentState, Increment]:
        """Update with one measurement.

        Returns:
            The new state, and the increment since the last usable frame.

        Raises:
            ValueError: As `checked` does, or if the shapes differ from those of the state or time goes backwards.
        """
        measurement = checked(measurement)
        self._check_against(state, measurement)
        batch = measurement.time.shape
        rows = int(np.prod(batch, dtype=np.int64))
        results = _align(
            state.history_time.reshape(rows, -1),
            state.history_angles.reshape(rows, self.history, -1),
            state.seen.reshape(rows),
            state.frame_time.reshape(rows),
            state.frame_joints.reshape(rows, -1),
            state.frame_features.reshape(rows, -1),
            measurement.joint_angles.reshape(rows, -1),
            measurement.features.reshape(rows, -1),
            measurement.visible.reshape(rows),
            measurement.frame_time.reshape(rows) - self.latency,
            measurement.time.reshape(rows),
        )
        shaped = [result.reshape((*batch, *result.shape[1:])) for result in results]
        return AlignmentState(*shaped[:6]), Increment(*shaped[6:])

    def _check_against(self, state: AlignmentState, measurement: ServoMeasurement) -> None:
        for name, value, known in (
            ("joint_angles", measurement.joint_angles, state.frame_joints),
            ("features", measurement.features, state.frame_features),
        ):
            if value.shape != known.shape:
                raise ValueError(
                    f"{name} must have the shape {known.shape} that the state was made for, got {value.shape}; "
                    "make a new state with initial(measurement)"
                )
        newest = state.history_time[..., -1]
        if state.history_time.shape[-1] != self.history:
            raise ValueError(
                f"the state holds {state.history_time.shape[-1]} readings, this alignment keeps history={self.history}"
                "; make a new state with initial(measurement)"
            )
        check_clock(measurement.time, newest, "start a new episode with initial(measurement)")


def check_clock(time: Array, newest: Array, remedy: str) -> None:
    """Raise ValueError if a clock went backwards.

    Args:
        time: Present time. Any shape, s.
        newest: Time of the last measurement, -inf before the first. The same shape.
        remedy: End of the message.
    """
    backwards = time < newest
    if backwards.any():
        raise ValueError(
            f"time must not go backwards, got {first_bad(time, backwards)} after {first_bad(newest, backwards)}; "
            f"{remedy}"
        )


def present_estimate(
    features: Array,
    jacobian: Array,
    increment: Increment,
    goal: Array,
    log_likelihood: Array,
    nis: Array,
) -> LinearEstimate:
    """Carry features from the newest frame's instant to the present: e = y - y_goal + J_theta dtheta + J_t dt.

    Args:
        features: Features at the newest frame's instant. Shape (*batch, m), px.
        jacobian: Total image Jacobian. Shape (*batch, m, n + 1), px/rad and px/s.
        increment: Increment whose pending parts are the motion since that instant.
        goal: Desired features. Shape (*batch, m), px.
        log_likelihood: Log density of the newest measurement. Shape (*batch,).
        nis: Normalized innovation squared divided by m. Shape (*batch,).

    Returns:
        The estimate at the present.
    """
    at_frame = LinearEstimate(features - np.asarray(goal), jacobian, log_likelihood, nis)
    now = at_frame.predict_error(increment.pending_joints, increment.pending_time)
    return LinearEstimate(now, jacobian, log_likelihood, nis)


@njit(cache=True, nogil=True)
def _align(  # type: ignore[no-untyped-def]
    history_time, history_angles, seen, frame_time, frame_joints, frame_features, angles, features, visible, stamp, time
):
    """`Alignment.step` over rows. Returns the fields of an AlignmentState, then those of an Increment."""
    rows, length, n = history_angles.shape
    m = features.shape[1]
    new_history_time = history_time.copy()
    new_history_angles = history_angles.copy()
    new_seen = seen.copy()
    new_frame_time = frame_time.copy()
    new_frame_joints = frame_joints.copy()
    new_frame_features = frame_features.copy()
    joints = np.zeros((rows, n))
    duration = np.zeros(rows)
    change = np.zeros((rows, m))
    fresh = np.zeros(rows, dtype=np.bool_)
    pending_joints = np.zeros((rows, n))
    pending_time = np.zeros(rows)
    at_frame = np.empty(n)

    for row in range(rows):
        times = new_history_time[row]
        readings = new_history_angles[row]
        if time[row] > times[length - 1]:
            for k in range(length - 1):
                times[k] = times[k + 1]
                readings[k] = readings[k + 1]
        times[length - 1] = time[row]
        readings[length - 1] = angles[row]

        instant = stamp[row]
        if visible[row] and instant >= times[0] and (not seen[row] or instant > frame_time[row]):
            k = length - 1
            while times[k] > instant:
                k -= 1
            weight = 0.0
            if k < length - 1 and times[k] > -np.inf:
                weight = (instant - times[k]) / (times[k + 1] - times[k])
            for i in range(n):
                at_frame[i] = readings[k, i]
                if weight > 0.0:
                    at_frame[i] += weight * (readings[k + 1, i] - readings[k, i])
            if seen[row]:
                fresh[row] = True
                duration[row] = instant - frame_time[row]
                for i in range(n):
                    joints[row, i] = at_frame[i] - frame_joints[row, i]
                for i in range(m):
                    change[row, i] = features[row, i] - frame_features[row, i]
            new_seen[row] = True
            new_frame_time[row] = instant
            new_frame_joints[row] = at_frame
            new_frame_features[row] = features[row]
        if new_seen[row]:
            pending_time[row] = time[row] - new_frame_time[row]
            for i in range(n):
                pending_joints[row, i] = angles[row, i] - new_frame_joints[row, i]
    return (
        new_history_time,
        new_history_angles,
        new_seen,
        new_frame_time,
        new_frame_joints,
        new_frame_features,
        joints,
        duration,
        change,
        fresh,
        pending_joints,
        pending_time,
    )
