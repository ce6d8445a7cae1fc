"""Errors of servo episodes, as the benchmark counts them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Array, Mask

TRANSIENT_SAMPLES = 126
"""One period of Zhang 2011's ellipse, start-up included."""
STEADY_AFTER = 3.0
"""s."""
SUCCESS_MEAN, SUCCESS_P95 = 0.010, 0.025
"""m."""
LOST_ERROR = 0.3
"""A step after an early end counts as at least this error, m."""
_CLOCK_TOLERANCE = 1e-9


def episode_clock(observation: Any, max_steps: int | None) -> tuple[float, int]:
    """Return the time at the reset, s, and the number of steps of a full episode.

    Args:
        observation: First observation; its `time` is the clock, shape (N, 1), s.
        max_steps: Steps of a full episode.

    Raises:
        ValueError: The observation has no clock, or the environment has no limit of steps.
    """
    if not isinstance(observation, Mapping) or "time" not in observation:
        raise ValueError(
            "a servo's observation must be a dictionary with the entry `time`; evaluate the id without wrappers "
            "that flatten observations"
        )
    if max_steps is None:
        raise ValueError("a servo environment must have a limit of steps; register it with max_episode_steps")
    return float(np.asarray(observation["time"])[0, 0]), max_steps


class ServoScoreRecorder:
    """Collects tracking and feature errors of a servo vector environment, step by step.

    Args:
        rows: Number of episodes side by side.
        observation: First observation; its `time` is the clock, shape (N, 1), s.
        max_steps: Steps of a full episode.

    Raises:
        ValueError: The observation has no clock, or the environment has no limit of steps.
    """

    def __init__(self, rows: int, observation: Any, max_steps: int | None) -> None:
        self._start, self._max_steps = episode_clock(observation, max_steps)
        self._times: list[Array] = []
        self._tracking: list[Array] = []
        self._features: list[Array] = []

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add one step.

        Args:
            observation: Observation of the vector environment after the step.
            info: Info of the same step, with `tracking_error` (m) and `feature_error` (px), shape (N,) each.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        # A row past its end repeats nothing here: `columns` reads each row only up to its own length.
        self._times.append(np.array(observation["time"], dtype=np.float64)[:, 0])
        self._tracking.append(np.array(info["tracking_error"], dtype=np.float64))
        self._features.append(np.array(info["feature_error"], dtype=np.float64))

    def columns(self, row: int, length: int) -> Row:
        """Columns of one episode: those of `servo_errors`, and the feature error after 3 s, px."""
        time = np.array([sample[row] for sample in self._times[:length]])
        tracking = np.array([sample[row] for sample in self._tracking[:length]])
        features = np.array([sample[row] for sample in self._features[:length]])
        return {
            **servo_errors(time, tracking, self._start, self._max_steps),
            "feature_error": _mean_or_last(features, time > STEADY_AFTER),
        }


def servo_errors(time: Array, error: Array, start: float, max_steps: int) -> Row:
    """Errors of one episode as the benchmark counts them.

    Args:
        time: Instants after each step; scoring starts after time 0. Shape (length,), s.
        error: Distance from the tool to the target at those instants. Shape (length,), m.
        start: Time at the reset, s.
        max_steps: Steps of a full episode; those missing count as the larger of the last error and `LOST_ERROR`.

    Returns:
        `transient`: mean of the first 126 scored samples; `steady` and `p95`: mean and 95th percentile for t > 3 s, all
        in m; `success`: steady below 10 mm and p95 below 25 mm.

    Raises:
        ValueError: A full episode has no samples after 3 s.
    """
    period = (time[-1] - start) / len(time)
    all_times = start + period * np.arange(1, max_steps + 1)
    full = np.full(max_steps, max(float(error[-1]), LOST_ERROR))
    full[: len(error)] = error
    scored = full[all_times > _CLOCK_TOLERANCE]
    late = full[all_times > STEADY_AFTER + _CLOCK_TOLERANCE]
    if late.size == 0:
        raise ValueError(
            f"an episode must last longer than {STEADY_AFTER:g} s to have a steady part, got {all_times[-1]:.2f} s; "
            "raise `horizon`"
        )
    steady, p95 = float(late.mean()), float(np.percentile(late, 95))
    return {
        "transient": float(scored[:TRANSIENT_SAMPLES].mean()),
        "steady": steady,
        "p95": p95,
        "success": steady < SUCCESS_MEAN and p95 < SUCCESS_P95,
    }


def _mean_or_last(values: Array, chosen: Mask) -> float:
    return float(values[chosen].mean()) if chosen.any() else float(values[-1])
