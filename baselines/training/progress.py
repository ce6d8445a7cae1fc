"""Evaluate a policy during training on tune seeds, next to classical agents on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.leaderboard.summary import AgentSummary, summarize
from servotrack.baselines.worlds import RANDOM_AGENT, world_of_id

EPISODES = 100
FIRST_SEED = 60_000
"""First seed in the tune range, apart from the seeds of tests and of `servotrack tune`."""
CLASSICAL = ("kf", "lifted-kf", "latency-bank-lifted-kf", "gm-phd", "pmb", "phd-servo")
"""Agents that are evaluated for comparison, in the worlds that they support."""


class Evaluation(Protocol):
    """Evaluation of a policy whenever a training measures it."""

    def measure(self, agent: AgentCard) -> dict[str, float]:
        """Return the numbers that the learning curve keeps; none is possible."""


class NoEvaluation:
    """Evaluation that plays no episode, for trainings whose environment steps are all counted."""

    def measure(self, agent: AgentCard) -> dict[str, float]:
        """Return nothing; see `Evaluation.measure`."""
        return {}


class PeriodicEvaluation:
    """Evaluates agents in one environment, or in several levels of it; then all numbers are means over the levels.

    Args:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        folder: Folder that keeps the results of the classical agents.
        episodes: Number of episodes per agent and level.
        levels: Levels of the environment; empty: the one in `env_kwargs`.
    """

    def __init__(
        self,
        env_id: str,
        env_kwargs: Mapping[str, Any],
        folder: ResultsFolder,
        episodes: int = EPISODES,
        levels: Sequence[int] = (),
    ) -> None:
        world = world_of_id(env_id)
        self.env_id, self.headline = env_id, world.headline
        self._worlds = [{**env_kwargs, "level": level} for level in levels] or [dict(env_kwargs)]
        self._seeds = seed_ranges.take("tune", episodes, FIRST_SEED)
        anchors = (world.anchors.lower, world.anchors.upper) if world.anchors else (RANDOM_AGENT,)
        names = [name for name in (*anchors, *CLASSICAL) if world.kind in AGENTS[name].worlds]
        self._references = [[self._cell(name, kwargs, folder) for name in names] for kwargs in self._worlds]

    @property
    def beside(self) -> dict[str, dict[str, float]]:
        """Mean metrics of the classical agents by name."""
        found = [
            {row.agent: self._measures(row) for row in summarize(cells)[0].rows if row.agent in CLASSICAL}
            for cells in self._references
        ]
        return {agent: _means([measured[agent] for measured in found]) for agent in found[0]}

    def measure(self, agent: AgentCard) -> dict[str, float]:
        """Return means over the episodes: `return`, and if the world has them `score`, `success` and its headline."""
        found = []
        for kwargs, cells in zip(self._worlds, self._references, strict=True):
            row = summarize([*cells, self._cell(agent, kwargs)])[0].row(agent.name)
            assert row is not None
            found.append(self._measures(row))
        return _means(found)

    def better(self, one: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Return True if `one` beats `other` by score, else by the headline metric, else by the return."""
        for name, sign in (
            ("score", 1.0), (self.headline.column, 1.0 if self.headline.high_is_good else -1.0), ("return", 1.0)
        ):  # fmt: skip
            if name in one and name in other:
                return sign * one[name] > sign * other[name]
        raise ValueError(f"measurements must share a measure, got {sorted(one)} and {sorted(other)}")

    def _cell(
        self, agent: str | AgentCard, env_kwargs: Mapping[str, Any], folder: ResultsFolder | None = None
    ) -> CellResults:
        return evaluate(self.env_id, agent, self._seeds, env_kwargs, folder=folder, timing=False)

    def _measures(self, row: AgentSummary) -> dict[str, float]:
        headline = row.measures.get(self.headline.column)
        found = {
            "return": row.mean_return,
            "score": row.score,
            "success": row.success,
            self.headline.column: headline,
        }
        return {name: float(interval.value) for name, interval in found.items() if interval is not None}


def _means(measured: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each metric."""
    return {name: sum(one[name] for one in measured) / len(measured) for name in measured[0]}
