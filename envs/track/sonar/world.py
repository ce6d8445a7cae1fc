"""N sonar scenes stepped together, for the single and the vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.envs.track.set_world import SetWorld
from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.envs.track.sonar.records import draw_record
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.types import Array, Labels, Mask


class SonarWorld(SetWorld):
    """N scenes with one observer each, stepped together. Arrays have a leading axis of N.

    The observer gets record k and answers with its estimate of the bearings at record k - lag. `step` scores the answer
    and advances to record k + 1. Records are drawn one by one, when they are needed. Scores are in deg.

    Args:
        config: Parameters of the environment.
        count: Number of scenes N.

    Attributes:
        observations: Newest records: beam powers relative to their noise level, shape (N, beams).
        bearings: True bearings at the newest record, shape (N, n), deg; zeros where a target does not exist.
        rates: True bearing rates, shape (N, n), deg/s.
        exists: Targets that exist at the newest record, shape (N, n), bool.
    """

    def __init__(self, config: SonarConfig, count: int) -> None:
        super().__init__(count, config.horizon, config.lag, config.estimate_rows, 1, config.cutoff)
        self.config = config
        n = config.max_targets
        self._scenes: list[SonarScene | None] = [None] * count
        self._shown: list[tuple[int, int] | None] = [None] * count
        self.observations = np.zeros((count, config.beams))
        self.bearings, self.rates = np.zeros((count, n)), np.zeros((count, n))
        self.exists = np.zeros((count, n), np.bool_)

    def _begin(self, row: int, seed: int) -> None:
        self._scenes[row] = draw_scene(self.config, seed)

    def _observe(self) -> None:
        for row, scene in enumerate(self._scenes):
            newest = int(self.seeds[row]), int(self.steps[row])
            # To draw a record takes longer than all else.
            if scene is None or self._shown[row] == newest:
                continue
            seed, step = self._shown[row] = newest
            self.observations[row] = np.minimum(draw_record(self.config, scene, seed, step), self.config.max_power)
            self.bearings[row], self.rates[row] = scene.bearings[step], scene.rates[step]
            self.exists[row] = scene.exists[step]

    def _truth_at(self, steps: Labels) -> tuple[Array, Mask]:
        bearings, exists = np.zeros_like(self.bearings), np.zeros_like(self.exists)
        for row, scene in enumerate(self._scenes):
            if scene is not None:
                bearings[row], exists[row] = scene.bearings[steps[row]], scene.exists[steps[row]]
        return bearings[..., None], exists

    def scene(self, row: int) -> SonarScene:
        """Return the targets of a scene over the whole episode."""
        scene = self._scenes[row]
        if scene is None:
            raise RuntimeError("a scene has no targets before its first reset: call reset()")
        return scene

    def answered(self) -> tuple[Array, Mask]:
        """Return true bearings (N, n), deg, and existence (N, n) at the record that the next answer is for."""
        at = self.steps - self.lag
        scored = self._is_scored(at)[:, None]
        bearings, exists = self._truth_at(np.where(scored[:, 0], at, 0))
        return np.where(scored, bearings[..., 0], 0.0), exists & scored

    def true_tracks(self, row: int) -> Array:
        """Return the true bearings at the scored records, shape (n, horizon, 1), deg; NaN if a target is absent."""
        scene, scored = self.scene(row), slice(0, self.config.horizon)
        return np.where(scene.exists[scored], scene.bearings[scored], np.nan).T[..., None]

    def truth(self) -> dict[str, Any]:
        """Return the entries of `info["truth"]` for the newest record, arrays of N rows."""
        return {"bearings": self.bearings, "rates": self.rates, "exists": self.exists}

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
