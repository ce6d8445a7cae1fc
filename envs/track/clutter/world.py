"""N clutter scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.clutter.config import ClutterConfig
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.resumed import draw_again, scored_state
from servotrack.envs.track.scoring import SetScorer
from servotrack.estimators.types import Array, Labels, Mask

_SCORES = (
    "truncated", "scored", "reward", "ospa", "gospa", "location", "missed", "false", "cardinality_error", "ospa2",
)  # fmt: skip


class ClutterWorld:
    """N scenes with one observer each, stepped together. Arrays have a leading axis of N.

    The observer gets scan k and answers with its estimate of the set of targets at scan k - lag. `step` scores the
    answer and advances to scan k + 1. After `reset` and `step` the attributes describe the newest scan; copy them to
    keep them.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        measurements: The newest scan, shape (N, M, 3): existence and two coordinates.
        states: True states now, shape (N, n, 4), m and m/s; zeros where a target does not exist.
        exists: Targets that exist now, shape (N, n), bool.
        source: Index of the target that caused each measurement, shape (N, M): -1 clutter, -2 an unused row.
        steps: Number of answered scans, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 if it was not scored.
        terminated: Always False, shape (N,).
        truncated: True if all scans are answered, shape (N,), bool.
        scored: True if the last answer was for a scan of the episode, shape (N,), bool.
        ospa, gospa, location, missed, false: Scores of the last answer, shape (N,), m; 0 if it was not scored.
        cardinality_error: Number of reported targets minus number of true ones, shape (N,), int; 0 if not scored.
        ospa2: OSPA(2) of the episode, shape (N,), m; 0 until `truncated`.
        scorer: Holds identities and reported rows of the last answer.
    """

    def __init__(self, config: ClutterConfig, count: int) -> None:
        self.config = config
        self.count = count
        scans, n, rows = config.horizon + 1 + config.lag, config.max_targets, config.measurement_rows
        self._states, self._exists = np.zeros((count, scans, n, 4)), np.zeros((count, scans, n), np.bool_)
        self._measurements = np.zeros((count, scans, rows, 3))
        self._source = np.full((count, scans, rows), -2, dtype=np.int64)
        self.scorer = SetScorer(count, config.estimate_rows, 2, config.horizon, config.cutoff)
        self.steps, self.seeds = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.scored = np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)
        self._observe()

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change.

        Args:
            rows: Indices of the scenes.
            seeds: Episode seed of each, non-negative integers.
        """
        for row, seed in zip(rows, seeds, strict=True):
            episode = draw_episode(self.config, seed)
            self._states[row], self._exists[row] = episode.states, episode.exists
            self._measurements[row], self._source[row] = episode.measurements, episode.source
            self.scorer.reset(row)
            self.seeds[row], self.steps[row], self.truncated[row], self.ospa2[row] = seed, 0, False, 0.0
        self._observe()

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers to the newest scans, and advance to the next scans.

        Args:
            answers: Existence and position (m) at scan `steps` - lag, shape (N, rows, 3).
            running: True for scenes whose episode is running, shape (N,), bool; None: all. The other scenes stay at
                their scan until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        config = self.config
        at = self.steps - config.lag
        self.scored = (at >= 0) & (at < config.horizon)
        _, _, states, exists = self._at(np.where(self.scored, at, 0))
        # An answer for a time before the first scan only starts identities.
        where = np.where(self.scored, at, config.horizon)
        scores = self.scorer.score(answers, states[..., [0, 2]], exists, where)
        self.ospa = np.where(self.scored, scores.ospa, 0.0)
        self.cardinality_error = np.where(self.scored, scores.cardinality_error, 0)
        self.gospa, self.location, self.missed, self.false = (np.where(self.scored, v, 0.0) for v in scores.gospa)
        self.reward = np.where(self.scored, -self.gospa / config.cutoff, 0.0)
        self.steps = self.steps + running
        self.truncated = self.steps >= self.episode_steps
        for row in np.flatnonzero(running & self.truncated).tolist():
            self.ospa2[row] = self.scorer.trajectory_score(row, self.true_tracks(row))
        self._observe()

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, the steps, and the scores so far."""
        return scored_state(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Scenes are drawn again from their seeds.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        draw_again(self, _SCORES, state, self.episode_steps)
        self._observe()

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

    def scores(self) -> dict[str, Any]:
        """Return the entries of `info` for the last answer, arrays of N rows."""
        return {
            "scored": self.scored,
            "ospa": self.ospa,
            "gospa": self.gospa,
            "location_error": self.location,
            "missed_error": self.missed,
            "false_error": self.false,
            "cardinality_error": self.cardinality_error,
        }

    def episode_scores(self) -> dict[str, Any]:
        """Return the entries of `info` at the end of an episode, arrays of N rows."""
        return {"ospa2": self.ospa2}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.horizon + self.config.lag

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
