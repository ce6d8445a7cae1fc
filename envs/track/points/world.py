"""N observers of recorded points, for the single and the vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.envs.track.points.recording import PointsConfig, load_points
from servotrack.envs.track.set_world import SetWorld
from servotrack.envs.wrappers import INTERVAL_KEY, NOISE_KEY, OBSERVATION_KEY
from servotrack.estimators.types import Array, Labels, Mask


class PointsWorld(SetWorld):
    """N observers of recorded points, each at its own scan. Attributes: see `SetWorld`, and below.

    After the last scan it is repeated.

    Args:
        config: Parameters of the environment.
        count: Number of observers N.

    Attributes:
        recording: Scans and truth.
        observations: The newest scans (N, M, 1 + d), the intervals before them (N, 1), s, and covariances of their
            points (N, M, d, d), m^2, if the file has them.

    Raises:
        SequenceError: A file cannot be used.
    """

    observations: dict[str, Array]

    def __init__(self, config: PointsConfig, count: int) -> None:
        self.config, self.recording = config, load_points(config)
        recording = self.recording
        rows, d = recording.estimate_rows, recording.points.dimensions
        super().__init__(count, recording.horizon, recording.lag, rows, d, recording.cutoff)
        self._observe()

    def _begin(self, row: int, seed: int) -> None:
        """Do nothing: every seed gives the same scans."""

    def _newest(self) -> Labels:
        return np.minimum(self.steps, len(self.recording.intervals) - 1)

    def _observe(self) -> None:
        at = self._newest()
        self.observations = {
            OBSERVATION_KEY: self.recording.measurements[at],
            INTERVAL_KEY: self.recording.intervals[at][:, None],
        }
        if self.recording.noises is not None:
            self.observations[NOISE_KEY] = self.recording.noises[at]

    def _is_scored(self, at: Labels) -> Mask:
        inside = super()._is_scored(at)
        return inside & self.recording.known[np.where(inside, at, 0)]

    def _truth_at(self, steps: Labels) -> tuple[Array, Mask]:
        return self.recording.positions[steps], self.recording.exists[steps]

    def true_tracks(self, row: int) -> Array:
        """Return the true positions at the scored scans, shape (n, horizon, d), m; NaN if a target is absent."""
        recording = self.recording
        tracks = np.where(recording.exists[..., None], recording.positions, np.nan)
        return tracks[: recording.horizon].swapaxes(0, 1)

    def truth(self) -> dict[str, Any]:
        """Return the entries of `info["truth"]` for the newest scan, arrays of N rows."""
        at = self._newest()
        positions, exists = self._truth_at(at)
        return {"positions": positions, "exists": exists, "source": self.recording.source[at]}

    def scores(self) -> dict[str, Any]:
        """Return the entries of `info` for the last answer, arrays of N rows; without truth only `scored`."""
        return {"scored": self.scored} if self.recording.truth is None else super().scores()

    def episode_scores(self) -> dict[str, Any]:
        """Return the entries of `info` at the end of an episode, arrays of N rows; empty without truth."""
        return {} if self.recording.truth is None else super().episode_scores()

    def privileged(self) -> dict[str, Array]:
        """Return the privileged information of oracle agents about the newest scan, arrays of N rows.

        Returns:
            `true_source` (N, M): index of the target of each point, -1 for none, -2 for an unused row;
            `true_positions` (N, n, d), m; `true_existence` (N, n), 0 or 1.

        Raises:
            ValueError: There is no truth.
        """
        if self.recording.truth is None:
            raise ValueError(f"truth is missing: {self.recording.name} has none for oracles; pass truth='truth.csv'")
        truth = self.truth()
        return {
            "true_source": truth["source"].astype(np.float64),
            "true_positions": truth["positions"],
            "true_existence": truth["exists"].astype(np.float64),
        }

    def debug_view(self, row: int = 0) -> str:
        """Return the state of an observer as text, for debugging."""
        at = self._newest()[row]
        return (
            f"{self.recording.name}  scan {self.steps[row]}/{self.episode_steps}  "
            f"time={self.recording.points.times[at]:g} s  points={len(self.recording.points.scans[at])}  "
            f"reported={int(self.scorer.reported[row].sum())}  ospa={self.ospa[row]:.4g} m"
        )
