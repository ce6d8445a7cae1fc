"""Scores of tracking episodes: OSPA, GOSPA and counts per step, OSPA(2) and MOT metrics of the whole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Array, Mask

_MEANS = ("ospa", "gospa")
_WHOLE = ("ospa2", "mota", "idf1", "hota")
"""Reported once, at the end of an episode; the last three where answers are boxes."""


class SetScoreRecorder:
    """Collects the scores in the infos of a tracking vector environment, step by step.

    Args:
        rows: Number of episodes side by side.
        observation: Not read.
        max_steps: Not read.
    """

    def __init__(self, rows: int, observation: Any = None, max_steps: int | None = None) -> None:
        self._steps: dict[str, list[Array]] = {name: [] for name in (*_MEANS, "cardinality_error")}
        self._scored: list[Mask] = []
        self._whole: list[Row] = [{} for _ in range(rows)]

    def record(self, observation: Any, info: Mapping[str, Any], ending: Mask) -> None:
        """Add the infos of one step.

        Args:
            observation: Not read.
            info: Info of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).

        Raises:
            ValueError: The world has no truth to score by.
        """
        for name, values in self._steps.items():
            if name not in info:
                raise ValueError(
                    "truth is missing: without it a sequence cannot be scored; give the environment its truth"
                )
            values.append(np.array(info[name], dtype=np.float64))
        self._scored.append(np.array(info.get("scored", np.ones(len(ending), np.bool_))))
        for row in np.flatnonzero(ending & info["episode_scored"]).tolist():
            self._whole[row] = {name: float(info[name][row]) for name in _WHOLE if name in info}

    def columns(self, row: int, length: int) -> Row:
        """Columns of one episode: means over its scored steps, and the scores of the whole."""
        scored = np.array([step[row] for step in self._scored[:length]])
        if not scored.any():
            raise ValueError("no step was scored: `horizon` must exceed `lag`")
        steps = {name: np.array([v[row] for v in values[:length]])[scored] for name, values in self._steps.items()}
        found: Row = {name: float(np.mean(steps[name])) for name in _MEANS}
        errors = steps["cardinality_error"]
        found["count_error"], found["count_right"] = float(np.mean(np.abs(errors))), float(np.mean(errors == 0.0))
        return found | self._whole[row]
