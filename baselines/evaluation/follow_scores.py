"""What the benchmark keeps of an episode in which one person is to be followed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Mask


class FollowScoreRecorder:
    """Collects what the following world's infos tell, step by step.

    Args:
        rows: Number of episodes side by side.
        max_steps: Steps of a full episode; those that an early end leaves out are neither on target nor at anybody.

    Raises:
        ValueError: The environment has no limit of steps.
    """

    def __init__(self, rows: int, max_steps: int | None) -> None:
        if max_steps is None:
            raise ValueError("an episode must have a limit of steps; register the environment with max_episode_steps")
        self._max_steps = max_steps
        self._wrong: list[Mask] = []
        self._right: list[Mask] = []
        self._whole: list[Row] = [{} for _ in range(rows)]

    def record(self, info: Mapping[str, Any], ending: Mask) -> None:
        """Take one step's infos in.

        Args:
            info: Of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        self._wrong.append(np.array(info["identity_error"], dtype=np.bool_))
        self._right.append(np.array(info["success"], dtype=np.bool_))
        for row in np.flatnonzero(ending).tolist():
            self._whole[row] = {name: int(info[name][row]) for name in ("losses", "reacquisitions")}
            self._whole[row]["kept"] = bool(info["kept"][row])

    def columns(self, row: int, length: int) -> Row:
        """One episode's columns: shares of the whole time, times lost; success: the person was kept to the end."""
        kept = bool(self._whole[row]["kept"]) and length == self._max_steps
        wrong = sum(int(step[row]) for step in self._wrong[:length])
        right = sum(int(step[row]) for step in self._right[:length])
        return {
            "time_on_target": right / self._max_steps,
            "identity_error": wrong / self._max_steps,
            "losses": self._whole[row]["losses"],
            "reacquisitions": self._whole[row]["reacquisitions"],
            "success": kept,
        }
