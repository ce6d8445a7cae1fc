"""What the benchmark keeps of an episode in a tracking world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.results import Row

Array = NDArray[np.float64]

_MEANS = ("ospa", "gospa")


class SetScoreRecorder:
    """Collects the scores that a tracking world's infos tell, step by step.

    Args:
        rows: Number of episodes side by side.
    """

    def __init__(self, rows: int) -> None:
        self._steps: dict[str, list[Array]] = {name: [] for name in (*_MEANS, "cardinality_error")}
        self._whole: list[float | None] = [None] * rows

    def record(self, info: Mapping[str, Any], ending: NDArray[np.bool_]) -> None:
        """Take one step's infos in.

        Args:
            info: Of the vector environment.
            ending: Rows whose episode ends with this step, shape (N,).
        """
        for name, values in self._steps.items():
            values.append(np.array(info[name], dtype=np.float64))
        told = np.asarray(info.get("_ospa2", np.zeros(len(ending), np.bool_)))
        for row in np.flatnonzero(ending & told).tolist():
            self._whole[row] = float(info["ospa2"][row])

    def columns(self, row: int, length: int) -> Row:
        """One episode's columns: means over its steps, OSPA(2) where the episode was told whole."""
        found: Row = {name: float(np.mean([v[row] for v in self._steps[name][:length]])) for name in _MEANS}
        found["count_error"] = float(np.mean([abs(v[row]) for v in self._steps["cardinality_error"][:length]]))
        if self._whole[row] is not None:
            found["ospa2"] = self._whole[row]
        return found
