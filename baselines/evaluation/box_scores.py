"""What the benchmark keeps of an episode in the color world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Array, Mask

_WHOLE = ("auc", "precision", "failures")


class BoxScoreRecorder:
    """Collects the scores that a color world's infos tell, step by step.

    Args:
        rows: Number of episodes side by side.
    """

    def __init__(self, rows: int) -> None:
        self._overlaps: list[Array] = []
        self._whole: list[Row] = [{} for _ in range(rows)]

    def record(self, info: Mapping[str, Any], ending: Mask) -> None:
        """Take one step's infos in.

        Args:
            info: Of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        self._overlaps.append(np.array(info["iou"], dtype=np.float64))
        told = np.asarray(info.get("_auc", np.zeros(len(ending), np.bool_)))
        for row in np.flatnonzero(ending & told).tolist():
            self._whole[row] = {name: float(info[name][row]) for name in _WHOLE}

    def columns(self, row: int, length: int) -> Row:
        """One episode's columns: mean IoU; AUC, precision and failures where the episode was told whole."""
        return {"iou": float(np.mean([step[row] for step in self._overlaps[:length]])), **self._whole[row]}
