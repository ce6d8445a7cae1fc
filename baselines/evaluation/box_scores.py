"""Scores of single-object tracking episodes: IoU per step; AUC, precision and failures of the whole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Array, Mask

_WHOLE = ("auc", "precision", "failures")


class BoxScoreRecorder:
    """Collects the scores in the infos of a single-object vector environment, step by step.

    Args:
        rows: Number of episodes side by side.
        observation: Not read.
        max_steps: Not read.
    """

    def __init__(self, rows: int, observation: Any = None, max_steps: int | None = None) -> None:
        self._overlaps: list[Array] = []
        self._whole: list[Row] = [{} for _ in range(rows)]

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add the infos of one step.

        Args:
            observation: Not read.
            info: Info of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        self._overlaps.append(np.array(info["iou"], dtype=np.float64))
        for row in np.flatnonzero(ending & info["episode_scored"]).tolist():
            self._whole[row] = {name: float(info[name][row]) for name in _WHOLE}

    def columns(self, row: int, length: int) -> Row:
        """Columns of one episode: mean IoU; AUC, precision and failures where the whole episode was scored."""
        return {"iou": float(np.mean([step[row] for step in self._overlaps[:length]])), **self._whole[row]}
