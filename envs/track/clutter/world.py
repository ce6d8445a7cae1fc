"""N clutter scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.envs.track.clutter.config import ClutterConfig
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.set_world import SetWorld
from servotrack.estimators.types import Array, Labels, Mask


class ClutterWorld(SetWorld):
    """N scenes with one observer each, stepped together. Attributes: see `SetWorld`, and below.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        measurements: The newest scan, shape (N, M, 3): existence and two coordinates.
        states: True states now, shape (N, n, 4), m and m/s; zeros where a target does not exist.
        exists: Targets that exist now, shape (N, n), bool.
        source: Index of the target that caused each measurement, shape (N, M): -1 clutter, -2 an unused row.
    """

    def __init__(self, config: ClutterConfig, count: int) -> None:
        super().__init__(count, config.horizon, config.lag, config.estimate_rows, 2, config.cutoff)
        self.config = config
        scans, n, rows = config.horizon + 1 + config.lag, config.max_targets, config.measurement_rows
        self._states, self._exists = np.zeros((count, scans, n, 4)), np.zeros((count, scans, n), np.bool_)
        self._measurements = np.zeros((count, scans, rows, 3))
        self._source = np.full((count, scans, rows), -2, dtype=np.int64)
        self._observe()

    def _begin(self, row: int, seed: int) -> None:
        episode = draw_episode(self.config, seed)
        self._states[row], self._exists[row] = episode.states, episode.exists
        self._measurements[row], self._source[row] = episode.measurements, episode.source

    def _truth_at(self, steps: Labels) -> tuple[Array, Mask]:
        rows = np.arange(self.count)
        return self._states[rows, steps][..., [0, 2]], self._exists[rows, steps]

    def _observe(self) -> None:
        self.measurements, self.source, self.states, self.exists = self._at(self.steps)

    def _at(self, steps: Labels) -> tuple[Array, Labels, Array, Mask]:
        """Return copies of one scan of each row: measurements, sources, true states and existence."""
        rows = np.arange(self.count)
        return (
            self._measurements[rows, steps],
            self._source[rows, steps],
            self._states[rows, steps],
            self._exists[rows, steps],
        )

    def true_tracks(self, row: int) -> Array:
        """Return the true positions at the scored scans, shape (n, horizon, 2), m; NaN if a target is absent."""
        positions = self._states[row, : self.config.horizon][:, :, [0, 2]]
        return np.where(self._exists[row, : self.config.horizon, :, None], positions, np.nan).swapaxes(0, 1)

    def scan(self, row: int, step: int) -> tuple[Array, Labels, Array, Mask]:
        """Return views of a scan: measurements (M, 3), sources (M,), true states (n, 4), existence (n,)."""
        return self._measurements[row, step], self._source[row, step], self._states[row, step], self._exists[row, step]

    @property
    def observations(self) -> Array:
        """Observations: the newest scans, shape (N, M, 3)."""
        return self.measurements

    def truth(self) -> dict[str, Any]:
        """Return the entries of `info["truth"]` for the newest scan, arrays of N rows."""
        return {"states": self.states, "exists": self.exists, "source": self.source}

    def privileged(self) -> dict[str, Array]:
        """Return the privileged information of oracle agents about the newest scan, arrays of N rows.

        Returns:
            `true_source` (N, M): index of the target that caused each measurement, -1 for clutter, -2 for an unused
            row; `true_states` (N, n, 4), m and m/s; `true_existence` (N, n), 0 or 1.
        """
        return {
            "true_source": self.source.astype(np.float64),
            "true_states": self.states.copy(),
            "true_existence": self.exists.astype(np.float64),
        }

    def debug_view(self, row: int = 0) -> str:
        """Return the state of a scene as text, for debugging."""
        return (
            f"scan {self.steps[row]}/{self.episode_steps}  targets={int(self.exists[row].sum())}  "
            f"measurements={int(self.measurements[row, :, 0].sum())}  reported={int(self.scorer.reported[row].sum())}  "
            f"ospa={self.ospa[row]:.2f} m  gospa={self.gospa[row]:.2f} m  cardinality {self.cardinality_error[row]:+d}"
        )
