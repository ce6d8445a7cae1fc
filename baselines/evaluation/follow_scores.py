"""Scores of episodes in which the arm follows one person: time on target, identity errors, losses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Mask


class FollowScoreRecorder:
    """Collects the counts in the infos of a following vector environment, step by step.

    Args:
        rows: Number of episodes side by side.
        observation: Not read.
        max_steps: Steps of a full episode. Steps after an early end count as neither on target nor at another person.

    Raises:
        ValueError: The environment has no limit of steps.
    """

    def __init__(self, rows: int, observation: Any, max_steps: int | None) -> None:
        if max_steps is None:
            raise ValueError("an episode must have a limit of steps; register the environment with max_episode_steps")
        self._max_steps = max_steps
        self._wrong: list[Mask] = []
        self._right: list[Mask] = []
        self._whole: list[Row] = [{} for _ in range(rows)]

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add the infos of one step.

        Args:
            observation: Not read.
            info: Info of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        self._wrong.append(np.array(info["identity_error"], dtype=np.bool_))
        self._right.append(np.array(info["success"], dtype=np.bool_))
        for row in np.flatnonzero(ending).tolist():
            self._whole[row] = {name: int(info[name][row]) for name in ("losses", "reacquisitions")}
            self._whole[row]["kept"] = bool(info["kept"][row])

    def columns(self, row: int, length: int) -> Row:
        """Columns of one episode: shares of the whole time, times lost; success if the person was kept to the end."""
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
