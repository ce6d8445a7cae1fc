"""Encoding of servo observations: the image error rotated with arm and camera, and the joint angles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.agents.learned.contract import PlainAnswers
from servotrack.baselines.agents.servo.jacobian_servo import OBSERVATION_KEYS
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Labels

READINGS = 8
"""Number of stored encoder readings, for frames that arrive late."""
ERROR_UNIT = 100.0
"""Unit of image errors in a row, px."""
DIFFERENCE_SCALE = 4.0
"""Factor of the differences between frames in a row."""
PERIODS_PER_SECOND = 20.0
"""Unit of frame ages: control periods of 50 ms."""
FRAME_SIZE = 10
"""Entries of one frame in a row."""
PRESENT_SIZE = 7
"""Entries of the present in a row."""
MOUNTING_PRIOR = (0.005, 0.0, 0.002)
"""Weak prior for a camera mounted straight: correlation of image and tool motion, and squared tool motion."""
RESIDUAL_LIMIT = 0.2
"""Bound of the residual of the image motion, hundreds of px, which limits the effect of outliers."""


class ServoMemory(NamedTuple):
    """Memory of a `ServoEncoding` with A ages.

    Attributes:
        times: Times of the last encoder readings, the newest last, s; before the first they repeat. Shape (N, 8).
        angles: The readings, rad. Shape (N, 8, 2).
        frames: Last frames, the newest first: error (2), visibility, age, action (2), and for each age cosine and sine
            of the first joint angle and of the sum of both (4 A). Shape (N, window, 6 + 4 A).
        turns: Statistics of each age: sum of image motions times conjugated tool motions (2), whose phase is that of
            the mounting, sum of squared tool motions, sum of squared residuals. Shape (N, A, 4).
        last: Error and tool position of the newest visible frame at each age. Shape (N, A, 4).
        seen: 1 after the first visible frame, else 0. Shape (N,).
    """

    times: Array
    angles: Array
    frames: Array
    turns: Array
    last: Array
    seen: Labels


@dataclass(frozen=True)
class ServoEncoding(PlainAnswers):
    """The image error of a planar arm's camera, rotated by arm and mounting, and its recent past.

    An eye-in-hand camera rotates with the arm. Rotated back by the sum of the joint angles at the frame's instant, the
    error is the target's position relative to the tool, up to an unknown scale and rotation that are constant in an
    episode. The rotation (the camera's mounting) is the phase of the running correlation of image motion and tool
    motion, computed for links of equal length; the error is rotated by it once more. The network has to learn the
    rest: the error of this estimate, the scale, the links, the target, and which inputs are reliable.

    Where time stamps are unreliable, the same is computed for several ages of the frame. The age whose tool motion has
    explained the image motion best so far is used.

    A row holds, of the newest observation and of `lags` before it: the rotated error (2, hundreds of px), cosine and
    sine of the first joint angle and of the sum of both at the frame (4), visibility, age in control periods, the
    action before it (2); of those before the newest, the first six as four times the difference from it. Then, of the
    present, the four cosines and sines, the time since scoring began clipped to [-1, 1] s, the logarithm of the
    evidence for the mounting, and the chosen age.

    Attributes:
        lags: Distances of the earlier observations from the newest, in observations, ascending.
        ages: Candidates for the age of a frame beyond its time stamp, control periods.
    """

    lags: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 11, 15)
    ages: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        """Check lags and ages."""
        object.__setattr__(self, "lags", tuple(int(lag) for lag in self.lags))
        object.__setattr__(self, "ages", tuple(float(age) for age in self.ages))
        if any(lag < 1 for lag in self.lags) or list(self.lags) != sorted(set(self.lags)):
            raise ValueError(f"lags must be whole numbers >= 1, ascending, got {self.lags!r}")
        if not self.ages or not all(0.0 <= age <= READINGS - 2 for age in self.ages):
            raise ValueError(f"ages must lie in 0..{READINGS - 2}, at least one, got {self.ages!r}")

    @property
    def size(self) -> int:
        """Length of a row."""
        return FRAME_SIZE * (1 + len(self.lags)) + PRESENT_SIZE

    @staticmethod
    def check(space: spaces.Space[Any]) -> None:
        """Raise ValueError unless a space is that of a servo with two joints and two features."""
        sizes = {key: 2 if key in ("joint_angles", "features", "goal") else 1 for key in OBSERVATION_KEYS}
        if not isinstance(space, spaces.Dict) or any(
            key not in space.spaces or space.spaces[key].shape != (size,) for key, size in sizes.items()
        ):
            raise ValueError(
                f"encoding servo reads a servo's observation with two joints and two features, got {space}"
            )

    def initial(self, observation: Mapping[str, NDArray[Any]]) -> ServoMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        times = np.repeat(np.asarray(observation["time"], np.float64), READINGS, axis=1)
        count, ages = len(times), len(self.ages)
        return ServoMemory(
            times,
            np.repeat(np.asarray(observation["joint_angles"])[:, None], READINGS, axis=1),
            np.zeros((count, 1 + max(self.lags, default=0), 6 + 4 * ages)),
            np.tile([*MOUNTING_PRIOR, 0.0], (count, ages, 1)),
            np.zeros((count, ages, 4)),
            np.zeros(count, np.int64),
        )

    def step(
        self, memory: ServoMemory, observation: Mapping[str, NDArray[Any]], action: FloatArray
    ) -> tuple[ServoMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        memory = ServoMemory._make(part.copy() for part in memory)
        rows = np.empty((len(memory.times), self.size), np.float32)
        _encode(
            memory, observation["joint_angles"], observation["features"], observation["goal"],
            observation["visible"], observation["frame_time"], observation["time"], action,
            self.lags, self.ages, rows,
        )  # fmt: skip
        return memory, rows


@njit(cache=True, nogil=True)
def _encode(  # type: ignore[no-untyped-def]
    memory, joint_angles, features, goal, visible, frame_time, time, action, lags, ages, rows
):
    """Update the memory with an observation and write one row per environment.

    Args:
        memory: Memory of the encoding, changed in place, `ServoMemory`.
        joint_angles: Encoder readings, (N, 2) rad.
        features: Features of the newest frame, (N, 2) px.
        goal: Goal features, (N, 2) px.
        visible: 1.0 if a new frame that shows the target arrived, else 0.0, (N, 1).
        frame_time: Time stamp of that frame, (N, 1) s.
        time: Current time, (N, 1) s.
        action: Action before the observation, (N, 2).
        lags: Distances of the earlier observations from the newest, in observations.
        ages: Candidates for the age of a frame beyond its time stamp, control periods.
        rows: Encoded rows, overwritten, (N, size) float32.
    """
    times, angles, frames, turns, last, seen = memory
    for i in range(len(times)):
        if time[i, 0] > times[i, -1]:
            times[i, :-1] = times[i, 1:]
            angles[i, :-1] = angles[i, 1:]
            times[i, -1] = time[i, 0]
        angles[i, -1] = joint_angles[i]

        for k in range(frames.shape[1] - 1, 0, -1):
            frames[i, k] = frames[i, k - 1]
        new = frames[i, 0]
        # The image's second axis points down: the error is the complex number u - iv.
        new[0], new[1] = (features[i, 0] - goal[i, 0]) / ERROR_UNIT, -(features[i, 1] - goal[i, 1]) / ERROR_UNIT
        new[2] = visible[i, 0]
        new[3] = min((time[i, 0] - frame_time[i, 0]) * PERIODS_PER_SECOND, float(READINGS))
        new[4], new[5] = action[i, 0], action[i, 1]
        best = 0
        for a in range(len(ages)):
            theta1, theta2 = _angles_at(times[i], angles[i], frame_time[i, 0] - ages[a] / PERIODS_PER_SECOND)
            at = 6 + 4 * a
            new[at], new[at + 1] = math.cos(theta1), math.sin(theta1)
            new[at + 2], new[at + 3] = math.cos(theta1 + theta2), math.sin(theta1 + theta2)
            if visible[i, 0] > 0.5:
                _correlate(new, at, turns[i, a], last[i, a], seen[i] > 0)
            if turns[i, a, 3] < turns[i, best, 3]:
                best = a
        if seen[i] == 0:
            frames[i] = new
        if visible[i, 0] > 0.5:
            seen[i] = 1

        evidence = math.hypot(turns[i, best, 0], turns[i, best, 1])
        c, s = turns[i, best, 0] / evidence, -turns[i, best, 1] / evidence
        row, at = rows[i], 6 + 4 * best
        u, v = _turned(new, at, c, s)
        row[0], row[1] = u, v
        row[2:6] = new[at : at + 4]
        row[6:FRAME_SIZE] = new[2:6]
        out = FRAME_SIZE
        for lag in lags:
            old = frames[i, lag]
            before_u, before_v = _turned(old, at, c, s)
            row[out], row[out + 1] = DIFFERENCE_SCALE * (before_u - u), DIFFERENCE_SCALE * (before_v - v)
            for j in range(4):
                row[out + 2 + j] = DIFFERENCE_SCALE * (old[at + j] - new[at + j])
            row[out + 6 : out + FRAME_SIZE] = old[2:6]
            out += FRAME_SIZE
        theta1, theta2 = joint_angles[i]
        row[out], row[out + 1] = math.cos(theta1), math.sin(theta1)
        row[out + 2], row[out + 3] = math.cos(theta1 + theta2), math.sin(theta1 + theta2)
        row[out + 4] = min(max(time[i, 0], -1.0), 1.0)
        row[out + 5] = 0.2 * math.log(evidence / MOUNTING_PRIOR[0])
        row[out + 6] = ages[best]


@njit(cache=True, nogil=True)
def _correlate(new, at, turn, last, before):  # type: ignore[no-untyped-def]
    """Add the image and tool motion since the last visible frame to the correlation."""
    u, v = _turned(new, at, 1.0, 0.0)
    x, y = new[at] + new[at + 2], new[at + 1] + new[at + 3]
    if before:
        # A tool motion q moves the image by -q, rotated and scaled.
        du, dv, qx, qy = u - last[0], v - last[1], last[2] - x, last[3] - y
        re, im = turn[0] / turn[2], turn[1] / turn[2]
        ru, rv = du - (re * qx - im * qy), dv - (re * qy + im * qx)
        turn[3] += min(ru * ru + rv * rv, RESIDUAL_LIMIT * RESIDUAL_LIMIT)
        turn[0] += du * qx + dv * qy
        turn[1] += dv * qx - du * qy
        turn[2] += qx * qx + qy * qy
    last[0], last[1], last[2], last[3] = u, v, x, y


@njit(cache=True, nogil=True)
def _turned(frame, at, c, s):  # type: ignore[no-untyped-def]
    """Return a frame's error rotated back by the joint angles at one age, and by c + is."""
    u = frame[at + 2] * frame[0] - frame[at + 3] * frame[1]
    v = frame[at + 3] * frame[0] + frame[at + 2] * frame[1]
    return c * u - s * v, s * u + c * v


@njit(cache=True, nogil=True)
def _angles_at(times, angles, instant):  # type: ignore[no-untyped-def]
    """Interpolate the joint angles at an instant; outside the stored readings, return the nearest one."""
    for k in range(len(times) - 1, 0, -1):
        if times[k - 1] <= instant:
            span = times[k] - times[k - 1]
            f = 1.0 if span <= 0.0 else min(max((instant - times[k - 1]) / span, 0.0), 1.0)
            return (
                angles[k - 1, 0] + f * (angles[k, 0] - angles[k - 1, 0]),
                angles[k - 1, 1] + f * (angles[k, 1] - angles[k - 1, 1]),
            )
    return angles[0, 0], angles[0, 1]
