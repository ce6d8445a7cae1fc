"""N sonar scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.state import State
from servotrack.envs.track.resumed import draw_again, scored_state
from servotrack.envs.track.scoring import SetScorer
from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.envs.track.sonar.records import draw_record
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.types import Array, Mask

_SCORES = (
    "truncated", "scored", "reward", "ospa", "gospa", "location", "missed", "false", "cardinality_error", "ospa2",
)  # fmt: skip


class SonarWorld:
    """N scenes with one observer each, stepped together. Arrays have a leading axis of N.

    The observer gets record k and answers with its estimate of the bearings at record k - lag. `step` scores the answer
    and advances to record k + 1. Records are drawn one by one, when they are needed.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        observations: Newest records: beam powers relative to their noise level, shape (N, beams).
        bearings: True bearings at the newest record, shape (N, n), deg; zeros where a target does not exist.
        rates: True bearing rates, shape (N, n), deg/s.
        exists: Targets that exist at the newest record, shape (N, n), bool.
        steps: Number of answered records, shape (N,).
        reward: -GOSPA / cutoff of the last answer, shape (N,); 0 if it was not scored.
        terminated: Always False, shape (N,).
        truncated: True if all records are answered, shape (N,), bool.
        scored: True if the last answer was for a record of the episode, shape (N,), bool.
        ospa, gospa, location, missed, false: Scores of the last answer, shape (N,), deg; 0 if it was not scored.
        cardinality_error: Number of reported targets minus number of true ones, shape (N,), int; 0 if not scored.
        ospa2: OSPA(2) of the episode, shape (N,), deg; 0 until `truncated`.
        scorer: Holds identities and reported rows of the last answer.
    """

    def __init__(self, config: SonarConfig, count: int) -> None:
        self.config = config
        self.count = count
        n = config.max_targets
        self._scenes: list[SonarScene | None] = [None] * count
        self.observations = np.zeros((count, config.beams))
        self.bearings, self.rates = np.zeros((count, n)), np.zeros((count, n))
        self.exists = np.zeros((count, n), np.bool_)
        self.scorer = SetScorer(count, config.estimate_rows, 1, config.horizon, config.cutoff)
        self.steps, self.seeds = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.terminated, self.truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.scored = np.zeros(count, np.bool_)
        self.reward, self.ospa, self.gospa = np.zeros(count), np.zeros(count), np.zeros(count)
        self.location, self.missed, self.false = np.zeros(count), np.zeros(count), np.zeros(count)
        self.cardinality_error, self.ospa2 = np.zeros(count, np.int64), np.zeros(count)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows do not change.

        Args:
            rows: Indices of the scenes.
            seeds: Episode seed of each, non-negative integers.
        """
        for row, seed in zip(rows, seeds, strict=True):
            self._scenes[row], self.seeds[row] = draw_scene(self.config, seed), seed
            self.scorer.reset(row)
            self.steps[row], self.truncated[row], self.ospa2[row] = 0, False, 0.0
            self._show(row)

    def step(self, answers: Array, running: Mask | None = None) -> None:
        """Score the answers, and advance to the next records.

        Args:
            answers: Existence and bearing (deg) at record `steps` - lag, shape (N, rows, 2).
            running: True for scenes whose episode is running, shape (N,), bool; None: all. The other scenes stay at
                their record until they are reset.
        """
        if running is None:
            running = np.ones(self.count, np.bool_)
        config = self.config
        at = self.steps - config.lag
        self.scored = (at >= 0) & (at < config.horizon)
        bearings, exists = self.answered()
        # An answer for a time before the first record only starts identities.
        scores = self.scorer.score(answers, bearings[..., None], exists, np.where(self.scored, at, config.horizon))
        self.ospa = np.where(self.scored, scores.ospa, 0.0)
        self.cardinality_error = np.where(self.scored, scores.cardinality_error, 0)
        self.gospa, self.location, self.missed, self.false = (np.where(self.scored, v, 0.0) for v in scores.gospa)
        self.reward = np.where(self.scored, -self.gospa / config.cutoff, 0.0)
        self.steps = self.steps + running
        self.truncated = self.steps >= config.horizon + config.lag
        for row in np.flatnonzero(running).tolist():
            if self.truncated[row]:
                self.ospa2[row] = self.scorer.trajectory_score(row, self.true_tracks(row))
            self._show(row)

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, the steps, and the scores so far."""
        return scored_state(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Scenes are drawn again from their seeds.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        draw_again(self, _SCORES, state, self.config.horizon + self.config.lag)
        for row in range(self.count):
            self._show(row)

    def _show(self, row: int) -> None:
        scene, step = self.scene(row), int(self.steps[row])
        self.observations[row] = np.minimum(
            draw_record(self.config, scene, int(self.seeds[row]), step), self.config.max_power
        )
        self.bearings[row], self.rates[row] = scene.bearings[step], scene.rates[step]
        self.exists[row] = scene.exists[step]

    def scene(self, row: int) -> SonarScene:
        """Return the targets of a scene over the whole episode."""
        scene = self._scenes[row]
        if scene is None:
            raise RuntimeError("a scene has no targets before its first reset: call reset()")
        return scene

    def answered(self) -> tuple[Array, Mask]:
        """Return true bearings (N, n), deg, and existence (N, n) at the record that the next answer is for."""
        bearings, exists = np.zeros_like(self.bearings), np.zeros_like(self.exists)
        for row, scene in enumerate(self._scenes):
            step = int(self.steps[row]) - self.config.lag
            if scene is not None and 0 <= step < self.config.horizon:
                bearings[row], exists[row] = scene.bearings[step], scene.exists[step]
        return bearings, exists

    def true_tracks(self, row: int) -> Array:
        """Return the true bearings at the scored records, shape (n, horizon, 1), deg; NaN if a target is absent."""
        scene, scored = self.scene(row), slice(0, self.config.horizon)
        return np.where(scene.exists[scored], scene.bearings[scored], np.nan).T[..., None]

    def truth(self) -> dict[str, Any]:
        """Return the entries of `info["truth"]` for the newest record, arrays of N rows."""
        return {"bearings": self.bearings, "rates": self.rates, "exists": self.exists}

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
        """Return the privileged information of oracle agents, arrays of N rows.

        Returns:
            `true_bearings` (N, n), deg, and `true_existence` (N, n), 0 or 1, at the record that the next answer is for.
        """
        bearings, exists = self.answered()
        return {"true_bearings": bearings, "true_existence": exists.astype(np.float64)}

    def debug_view(self, row: int = 0) -> str:
        """Return the state of a scene as text, for debugging."""
        config = self.config
        return (
            f"record {self.steps[row]}/{config.horizon + config.lag}  targets={int(self.exists[row].sum())}  "
            f"loudest beam={config.beam_bearings[self.observations[row].argmax()]:.2f} deg  "
            f"reported={int(self.scorer.reported[row].sum())}  ospa={self.ospa[row]:.2f} deg  "
            f"gospa={self.gospa[row]:.2f} deg  cardinality {self.cardinality_error[row]:+d}"
        )
