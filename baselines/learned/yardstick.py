"""What a learner is measured by while it learns: episodes on tune seeds, beside classical agents on the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotrack.baselines import seeds as seed_ranges
from servotrack.baselines.evaluate import evaluate
from servotrack.baselines.leaderboard.measures import JUDGMENTS
from servotrack.baselines.leaderboard.summary import LOWER_ANCHOR, UPPER_ANCHOR, AgentSummary, summarize
from servotrack.baselines.protocol import AgentCard, world_of
from servotrack.baselines.registry import AGENTS
from servotrack.baselines.results import CellResults, ResultsFolder

EPISODES = 100
FIRST_SEED = 60_000
"""Offset in the tune range, away from the seeds of tests and of `servotrack tune`."""
BESIDE = ("kf", "lifted-kf", "latency-bank-lifted-kf", "gm-phd", "pmb", "phd-servo")
"""Agents whose measures are shown beside the learner's, where they can act."""


class Yardstick:
    """Measures agents of one environment.

    Args:
        env_id: Gymnasium id.
        env_kwargs: Its arguments.
        folder: Keeps what the classical agents reached.
        episodes: Per agent.
    """

    def __init__(
        self, env_id: str, env_kwargs: Mapping[str, Any], folder: ResultsFolder, episodes: int = EPISODES
    ) -> None:
        self.env_id, self.env_kwargs = env_id, dict(env_kwargs)
        self.headline = JUDGMENTS[world_of(env_id)].headline
        self._seeds = seed_ranges.take("tune", episodes, FIRST_SEED)
        world = world_of(env_id)
        names = [name for name in (LOWER_ANCHOR, UPPER_ANCHOR, *BESIDE) if world in AGENTS[name].worlds]
        self._references = [self._cell(name, folder) for name in names]

    @property
    def beside(self) -> dict[str, dict[str, float]]:
        """Measures of the classical agents, by their names."""
        rows = summarize(self._references)[0].rows
        return {row.agent: self._measures(row) for row in rows if row.agent in BESIDE}

    def measure(self, agent: AgentCard) -> dict[str, float]:
        """Means over the episodes: `return`, and where the world has them `score`, `success` and its headline."""
        task = summarize([*self._references, self._cell(agent)])[0]
        row = task.row(agent.name)
        assert row is not None
        return self._measures(row)

    def better(self, one: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Whether one measurement is better than another: by score, else by the headline, else by the return."""
        for name, sign in (
            ("score", 1.0), (self.headline.column, 1.0 if self.headline.high_is_good else -1.0), ("return", 1.0)
        ):  # fmt: skip
            if name in one and name in other:
                return sign * one[name] > sign * other[name]
        raise ValueError(f"measurements must share a measure, got {sorted(one)} and {sorted(other)}")

    def _cell(self, agent: str | AgentCard, folder: ResultsFolder | None = None) -> CellResults:
        return evaluate(self.env_id, agent, self._seeds, self.env_kwargs, folder=folder, timing=False)

    def _measures(self, row: AgentSummary) -> dict[str, float]:
        headline = row.measures.get(self.headline.column)
        found = {
            "return": row.mean_return,
            "score": row.score,
            "success": row.success,
            self.headline.column: headline,
        }
        return {name: float(interval.value) for name, interval in found.items() if interval is not None}
