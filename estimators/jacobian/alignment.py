"""Pairing of joint motion and feature motion by time stamps.

An increment dy belongs to the dtheta of the same interval: one frame of uncompensated latency breaks every Jacobian
estimator. Therefore the latest encoder readings are kept and interpolated at the frames' instants.
"""

from __future__ import annotations

import functools
import math
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
        waiting_time: Instants of frames that are newer than the newest reading, oldest first, -inf for none. Shape
            (*batch, W), s; W is 0 while encoder readings have no stamps of their own.
        waiting_features: Features of these frames. Shape (*batch, W, m), px.
    """

    history_time: Array
    history_angles: Array
    seen: Mask
    frame_time: Array
    frame_joints: Array
    frame_features: Array
    waiting_time: Array
    waiting_features: Array


class Readings(NamedTuple):
    """Rows of measurements, for the kernel; `stamp` is the instant of the frame, `read_at` that of the encoders."""

    angles: Array
    features: Array
    visible: Mask
    stamp: Array
    read_at: Array
    time: Array


@dataclass(frozen=True)
class Alignment:
    """Conversion of measurements into increments whose joint and feature parts belong to the same interval.

    A frame is not fresh if it is repeated, does not show the target, goes back in time, or is older than the history.
    After dropped frames the next increment spans the gap. The arm is assumed to be at rest before the first reading.
    If encoder readings have stamps of their own (`joint_time`), a frame waits for the readings around its instant.

    Args:
        history: Number H of encoder readings kept, at least 2. It must cover the latency.
        latency: Age of a frame at its stamp, s, subtracted from `frame_time`. Use it for cameras that stamp frames on
            arrival.
        revolute: True for each joint that turns, whose readings may jump by whole turns; None: all. Shape (n,).
        play: Play of the gears between encoders and links: links follow only when it is used up, and all joint angles
            of the state are those of the links. A number, or shape (n,), rad.
    """

    history: int = 16
    latency: float = 0.0
    revolute: tuple[bool, ...] | None = None
    play: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        play = np.asarray(self.play, np.float64)
        if play.ndim > 1 or not ((play >= 0.0) & (play < np.inf)).all():
            raise ValueError(f"play must be a finite number >= 0 rad, or one per joint, got {self.play}")
        object.__setattr__(self, "play", float(play) if play.ndim == 0 else tuple(play.tolist()))
        if self.revolute is not None:
            object.__setattr__(self, "revolute", tuple(bool(turns) for turns in self.revolute))
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
        gears(self.revolute, self.play, n)
        waiting = 0 if measurement.joint_time is None else self.history
        return AlignmentState(
            history_time=np.full((*batch, self.history), -np.inf),
            history_angles=np.repeat(measurement.joint_angles[..., None, :], self.history, axis=-2).reshape(
                *batch, self.history, n
            ),
            seen=np.zeros(batch, dtype=np.bool_),
            frame_time=measurement.time.copy(),
            frame_joints=measurement.joint_angles.copy(),
            frame_features=measurement.goal.copy(),
            waiting_time=np.full((*batch, waiting), -np.inf),
            waiting_features=np.zeros((*batch, waiting, measurement.features.shape[-1])),
        )

    def step(self, state: AlignmentState, measurement: ServoMeasurement) -> tuple[AlignmentState, Increment]:
        """Update with one measurement.

        Returns:
            The new state, and the increment since the last usable frame.

        Raises:
            ValueError: As `checked` does, or if the shapes differ from those of the state or time goes backwards.
        """
        measurement = checked(measurement)
        self.check_against(state, measurement)
        batch, n, m = measurement.time.shape, measurement.joint_angles.shape[-1], measurement.features.shape[-1]
        read_at = measurement.time if measurement.joint_time is None else measurement.joint_time
        rows = math.prod(batch)
        waiting = state.waiting_time.shape[-1]
        before = AlignmentState(
            state.history_time.reshape(rows, self.history),
            state.history_angles.reshape(rows, self.history, n),
            state.seen.reshape(rows),
            state.frame_time.reshape(rows),
            state.frame_joints.reshape(rows, n),
            state.frame_features.reshape(rows, m),
            state.waiting_time.reshape(rows, waiting),
            state.waiting_features.reshape(rows, waiting, m),
        )
        readings = Readings(
            measurement.joint_angles.reshape(rows, n),
            measurement.features.reshape(rows, m),
            measurement.visible.reshape(rows),
            measurement.frame_time.reshape(rows) - self.latency,
            read_at.reshape(rows),
            measurement.time.reshape(rows),
        )
        turning, half_play = gears(self.revolute, self.play, n)
        results = align_rows(before, readings, turning, half_play[None])
        shaped = [result.reshape((*batch, *result.shape[1:])) for result in results]
        return AlignmentState(*shaped[:8]), Increment(*shaped[8:])

    def check_against(self, state: AlignmentState, measurement: ServoMeasurement) -> None:
        """Raise ValueError if a checked measurement does not continue a state."""
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
        if (measurement.joint_time is None) != (state.waiting_time.shape[-1] == 0):
            given = "no joint_time" if measurement.joint_time is None else "a joint_time"
            raise ValueError(
                f"joint_time must be given at every step or at none, got {given}, unlike the first measurement; "
                "make a new state with initial(measurement)"
            )
        if measurement.joint_time is None:
            check_clock(measurement.time, newest, "start a new episode with initial(measurement)")
        else:
            late = "repeat the newest reading with its stamp, or start a new episode with initial(measurement)"
            check_clock(measurement.joint_time, newest, late, "joint_time")


@functools.lru_cache(maxsize=256)
def gears(revolute: tuple[bool, ...] | None, play: float | tuple[float, ...], joints: int) -> tuple[Mask, Array]:
    """Mask of the joints that turn, and half of the play of each. Shapes (n,).

    Raises:
        ValueError: Another number of joints.
    """
    for name, value in (("revolute", revolute), ("play", play)):
        if isinstance(value, tuple) and len(value) != joints:
            kind = "have one entry per joint" if name == "revolute" else "be one number or one per joint"
            none = "; None: all turn" if name == "revolute" else ""
            raise ValueError(f"{name} must {kind}, got {len(value)} for {joints} joints{none}")
    turning = np.ones(joints, np.bool_) if revolute is None else np.array(revolute, np.bool_)
    return turning, 0.5 * np.broadcast_to(np.asarray(play, np.float64), joints).copy()


def check_clock(time: Array, newest: Array, remedy: str, name: str = "time") -> None:
    """Raise ValueError if a clock went backwards.

    Args:
        time: Present time. Any shape, s.
        newest: Time of the last measurement, -inf before the first. The same shape.
        remedy: End of the message.
        name: Name of the field, with which the message begins.
    """
    backwards = time < newest
    if backwards.any():
        raise ValueError(
            f"{name} must not go backwards, got {first_bad(time, backwards)} after {first_bad(newest, backwards)}; "
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
def align_rows(before, now, turning, half_play):  # type: ignore[no-untyped-def]
    """`Alignment.step` over rows. Returns the fields of an AlignmentState, then those of an Increment.

    Args:
        before: An `AlignmentState` with a leading axis of rows.
        now: `Readings`.
        turning: True for joints that turn. Shape (n,).
        half_play: Half of the play of each joint, taken in turn by the rows. Shape (K, n), rad.
    """
    rows, length, n = before.history_angles.shape
    m = now.features.shape[1]
    places = before.waiting_time.shape[1]
    seen, frame_time, frame_joints, frame_features = (
        before.seen,
        before.frame_time,
        before.frame_joints,
        before.frame_features,
    )
    new_history_time = before.history_time.copy()
    new_history_angles = before.history_angles.copy()
    new_seen = seen.copy()
    new_frame_time = frame_time.copy()
    new_frame_joints = frame_joints.copy()
    new_frame_features = frame_features.copy()
    new_waiting_time = before.waiting_time.copy()
    new_waiting_features = before.waiting_features.copy()
    joints = np.zeros((rows, n))
    duration = np.zeros(rows)
    change = np.zeros((rows, m))
    fresh = np.zeros(rows, dtype=np.bool_)
    pending_joints = np.zeros((rows, n))
    pending_time = np.zeros(rows)
    at_frame = np.empty(n)
    found = np.empty(m)

    for row in range(rows):
        times = new_history_time[row]
        readings = new_history_angles[row]
        if now.read_at[row] > times[length - 1]:
            for k in range(length - 1):
                times[k] = times[k + 1]
                for i in range(n):
                    readings[k, i] = readings[k + 1, i]
        times[length - 1] = now.read_at[row]
        for i in range(n):
            reading = now.angles[row, i]
            # No joint turns by half a turn between two readings: it is the encoder that has jumped.
            jump = reading - readings[length - 2, i]
            if turning[i] and abs(jump) > np.pi:
                reading -= 2.0 * np.pi * np.rint(jump / (2.0 * np.pi))
            link = readings[length - 2, i]
            play = half_play[row % half_play.shape[0], i]
            readings[length - 1, i] = min(max(link, reading - play), reading + play)

        instant = -np.inf
        if now.visible[row] and now.stamp[row] >= times[0] and (not seen[row] or now.stamp[row] > frame_time[row]):
            instant = now.stamp[row]
            for i in range(m):
                found[i] = now.features[row, i]
        if places > 0:
            instant = _next_frame(
                new_waiting_time[row], new_waiting_features[row], instant, found, times[length - 1] + 1e-9
            )
        if instant > -np.inf:
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
                    change[row, i] = found[i] - frame_features[row, i]
            new_seen[row] = True
            new_frame_time[row] = instant
            for i in range(n):
                new_frame_joints[row, i] = at_frame[i]
            for i in range(m):
                new_frame_features[row, i] = found[i]
        if new_seen[row]:
            pending_time[row] = now.time[row] - new_frame_time[row]
            step, age = times[length - 1] - times[length - 2], now.time[row] - times[length - 1]
            for i in range(n):
                pending_joints[row, i] = readings[length - 1, i] - new_frame_joints[row, i]
                if age > 0.0 and step < np.inf:
                    pending_joints[row, i] += age / step * (readings[length - 1, i] - readings[length - 2, i])
    return (
        new_history_time,
        new_history_angles,
        new_seen,
        new_frame_time,
        new_frame_joints,
        new_frame_features,
        new_waiting_time,
        new_waiting_features,
        joints,
        duration,
        change,
        fresh,
        pending_joints,
        pending_time,
    )


@njit(cache=True, nogil=True)
def _next_frame(times, features, instant, found, newest):  # type: ignore[no-untyped-def]
    """Put the frame of `instant` (-inf: none) with features `found` into the queue, and take one out.

    Returns the instant of the newest frame that is not after `newest`, with its features in `found`; -inf if there is
    none. Frames before it leave the queue, and the oldest one where the queue is full.
    """
    places = times.shape[0]
    if instant > times[places - 1]:
        for k in range(places - 1):
            times[k] = times[k + 1]
            features[k] = features[k + 1]
        times[places - 1] = instant
        features[places - 1] = found
    taken = -np.inf
    for k in range(places):
        if -np.inf < times[k] <= newest:
            taken = times[k]
            found[:] = features[k]
            times[k] = -np.inf
    return taken
