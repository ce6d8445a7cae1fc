"""From a vector environment's steps to one row per episode: return and length of any, errors of servos, set scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.box_scores import BoxScoreRecorder
from servotrack.baselines.evaluation.follow_scores import FollowScoreRecorder
from servotrack.baselines.evaluation.results import Row
from servotrack.baselines.evaluation.set_scores import SetScoreRecorder
from servotrack.estimators.types import Array, Mask

TRANSIENT_SAMPLES = 126
"""One period of paper 002's ellipse, start-up included."""
STEADY_AFTER = 3.0
"""s."""
SUCCESS_MEAN, SUCCESS_P95 = 0.010, 0.025
"""m."""
LOST_ERROR = 0.3
"""A step after an early end counts as at least this error, m."""
_CLOCK_TOLERANCE = 1e-9


class EpisodeRecorder:
    """Collects the first episode of every row of a vector environment.

    Args:
        seeds: One per row.
        env: The vector environment.
        observation: What reset returned.
        info: What reset returned.

    Raises:
        ValueError: A servo environment too short to have a steady part.
    """

    def __init__(self, seeds: Sequence[int], env: Any, observation: Any, info: Mapping[str, Any]) -> None:
        self._seeds = list(seeds)
        rows = len(self._seeds)
        self.max_steps = _max_steps(env)
        follows = "identity_error" in info
        timed = isinstance(observation, Mapping) and "time" in observation
        self.is_servo = timed and "tracking_error" in info and not follows
        self.ended: Mask = np.zeros(rows, dtype=bool)
        self._alive: Mask = np.ones(rows, dtype=bool)
        self._returns = np.zeros(rows)
        self._lengths = np.zeros(rows, dtype=np.int64)
        self._successes: list[bool | None] = [None] * rows
        self._sets: SetScoreRecorder | BoxScoreRecorder | FollowScoreRecorder | None = None
        if follows:
            self._sets = FollowScoreRecorder(rows, self.max_steps)
        self._times: list[Array] = []
        self._tracking: list[Array] = []
        self._features: list[Array] = []
        if self.is_servo:
            if self.max_steps is None:
                raise ValueError("a servo environment must have a limit of steps; register it with max_episode_steps")
            self._start = float(np.asarray(observation["time"])[0, 0])

    @property
    def finished(self) -> bool:
        """Whether every row's episode has ended."""
        return not self._alive.any()

    def record(self, observation: Any, reward: Any, ended: Mask, info: Mapping[str, Any]) -> None:
        """Take one step of the vector environment in; rows whose episode ended earlier are ignored."""
        self.ended = np.array(ended, dtype=bool)
        self._returns[self._alive] += np.asarray(reward, dtype=np.float64)[self._alive]
        self._lengths += self._alive
        if self.is_servo:
            # A row that is past its end repeats nothing here: `rows` reads each row only up to its own length.
            self._times.append(np.array(observation["time"], dtype=np.float64)[:, 0])
            self._tracking.append(np.array(info["tracking_error"], dtype=np.float64))
            self._features.append(np.array(info["feature_error"], dtype=np.float64))
        else:
            for row in np.flatnonzero(self._alive & self.ended):
                self._successes[row] = _final_success(info, int(row))
        if self._sets is None and "iou" in info:
            self._sets = BoxScoreRecorder(len(self._seeds))
        if self._sets is None and "ospa" in info:
            self._sets = SetScoreRecorder(len(self._seeds))
        if self._sets is not None:
            self._sets.record(info, self._alive & self.ended)
        self._alive &= ~self.ended

    def rows(self) -> list[Row]:
        """One row per seed, in their order."""
        rows = []
        for i, seed in enumerate(self._seeds):
            row: Row = {"seed": seed, "return": float(self._returns[i]), "length": int(self._lengths[i])}
            if self.is_servo:
                row |= self._servo_columns(i)
            elif self._sets is not None:
                row |= self._sets.columns(i, row["length"])
            elif self._successes[i] is not None:
                row["success"] = self._successes[i]
            rows.append(row)
        return rows

    def _servo_columns(self, i: int) -> Row:
        length = int(self._lengths[i])
        time = np.array([sample[i] for sample in self._times[:length]])
        tracking = np.array([sample[i] for sample in self._tracking[:length]])
        features = np.array([sample[i] for sample in self._features[:length]])
        assert self.max_steps is not None
        return {
            **servo_errors(time, tracking, self._start, self.max_steps),
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


def _final_success(info: Mapping[str, Any], row: int) -> bool | None:
    for key in ("success", "is_success"):
        if key in info and np.asarray(info.get(f"_{key}", True)).reshape(-1)[row if f"_{key}" in info else 0]:
            return bool(np.asarray(info[key])[row])
    return None


def _max_steps(env: Any) -> int | None:
    """Steps of a full episode: those that a servo's configuration says, or those that the id was registered with."""
    config: Any = getattr(env.unwrapped, "config", None)
    if hasattr(config, "warmup") and hasattr(config, "horizon"):
        return int(config.warmup + config.horizon)
    own = None if env.spec is None else env.spec.max_episode_steps
    return None if own is None else int(own)
