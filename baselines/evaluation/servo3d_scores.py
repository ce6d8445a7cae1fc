"""Scores of episodes in which a serial arm reaches and holds a pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.evaluation.servo_scores import episode_clock
from servotrack.estimators.types import Array, Mask

DISTANCE_BOUND, ANGLE_BOUND = 2e-3, np.radians(1.0)
"""Bounds within which the tool counts as at the goal, m and rad."""
APPROACH_SHARE, HOLDING_SHARE = 0.25, 0.5
"""Share of a full episode after which errors count (10 s of 40 s), and share at its end that decides on success."""
LOST_DISTANCE, LOST_ANGLE, LOST_ERROR = 0.5, np.pi, 500.0
"""A step after an early end counts as at least this far away: m, rad, and in units of the bounds."""
LEAST_ERROR = 0.01
"""Smallest mean error that counts, in units of the bounds (0.02 mm, 0.01 degree): finer than any arm repeats."""


class Servo3DScoreRecorder:
    """Collects the errors of a vector environment of serial arms, step by step.

    Args:
        rows: Number of episodes side by side.
        observation: First observation; its `time` is the clock, shape (N, 1), s.
        max_steps: Steps of a full episode.

    Raises:
        ValueError: The observation has no clock, or the environment has no limit of steps.
    """

    def __init__(self, rows: int, observation: Any, max_steps: int | None) -> None:
        self._start, self._max_steps = episode_clock(observation, max_steps)
        self._samples: list[Array] = []

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add one step.

        Args:
            observation: Observation of the vector environment after the step.
            info: Info of the same step, with `tip_error` (m), `tip_angle` (rad), `tracking_error` (both in units of
                their bounds) and `feature_error` (px), shape (N,) each.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        # A row past its end repeats nothing here: `columns` reads each row only up to its own length.
        names = ("tip_error", "tip_angle", "tracking_error", "feature_error")
        columns = [np.asarray(observation["time"])[:, 0], *(info[name] for name in names)]
        self._samples.append(np.array(columns, dtype=np.float64))

    def columns(self, row: int, length: int) -> Row:
        """Columns of one episode, see `servo3d_errors`, and the feature error after the approach, px."""
        time, tip, angle, error, feature = np.array([sample[:, row] for sample in self._samples[:length]]).T
        late = feature[round(APPROACH_SHARE * self._max_steps) :]
        return {
            **servo3d_errors(time, tip, angle, error, self._start, self._max_steps),
            "feature_error": float(late.mean()) if late.size else float(feature[-1]),
        }


def servo3d_errors(time: Array, tip: Array, angle: Array, error: Array, start: float, max_steps: int) -> Row:
    """Errors of one episode as the benchmark counts them.

    Args:
        time: Instants after each step. Shape (length,), s.
        tip: Distance of the tool from the goal. Shape (length,), m.
        angle: Angle between the tool and the goal. Shape (length,), rad.
        error: Both in units of their bounds, combined. Shape (length,).
        start: Time at the reset, s.
        max_steps: Steps of a full episode; those missing count as the larger of the last error and the lost errors.

    Returns:
        `settle`: time after which the tool stays within 2 mm and 1 degree to the end, the whole episode if it does not,
        s; `hold`: mean of `error` after the first quarter, at least 0.01; `tip`: median distance after it, m;
        `success`: in the second half the mean distance is below 2 mm and the mean angle below 1 degree.
    """
    period = (time[-1] - start) / len(time)

    def whole(values: Array, least: float) -> Array:
        full = np.full(max_steps, max(float(values[-1]), least))
        full[: len(values)] = values
        return full

    tips, angles, errors = whole(tip, LOST_DISTANCE), whole(angle, LOST_ANGLE), whole(error, LOST_ERROR)
    outside = np.flatnonzero((tips >= DISTANCE_BOUND) | (angles >= ANGLE_BOUND))
    # The first sample after the last one outside; at index k the time is (k + 1) periods.
    steps = 1 if outside.size == 0 else min(int(outside[-1]) + 2, max_steps)
    after, holding = round(APPROACH_SHARE * max_steps), round((1.0 - HOLDING_SHARE) * max_steps)
    return {
        "settle": steps * period,
        "hold": max(float(errors[after:].mean()), LEAST_ERROR),
        "tip": float(np.median(tips[after:])),
        "success": bool(tips[holding:].mean() < DISTANCE_BOUND and angles[holding:].mean() < ANGLE_BOUND),
    }
