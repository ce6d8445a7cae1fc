"""Anchors of the score in one task: which episodes count, and why there is no score where there is none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation import statistics
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.evaluation.seeds import SPLITS
from servotrack.baselines.worlds import ScoreAnchors
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Anchoring:
    """Errors between which a task's scores are scaled.

    Attributes:
        ends: Names, column, and the least share of an error.
        seeds: Seeds of the anchors' episodes, those that both have.
        lower: Errors of the agent without skill, shape (n,).
        upper: Errors of the agent that knows the system, shape (n,).
    """

    ends: ScoreAnchors
    seeds: frozenset[int]
    lower: Array
    upper: Array

    def scores(self, cell: CellResults, errors: Array) -> Array | None:
        """Return a score per episode; None for an agent with episodes that the anchors lack.

        Args:
            cell: Results of the agent.
            errors: Error of each episode, shape (k,).
        """
        if not self.seeds.issuperset(cell.seeds):
            return None
        floor = self.ends.least_share * float(self.upper.min())
        return statistics.score(np.maximum(errors, floor), self.lower, self.upper)

    def missing(self, cells: Iterable[CellResults]) -> list[str]:
        """Return a sentence for each agent that has no score because the anchors lack some of its episodes."""
        return [
            f"No score for {cell.agent}: {self.ends.lower} and {self.ends.upper} lack {lacking} of its "
            f"{len(cell.rows)} episodes; evaluate them on as many."
            for cell in cells
            if (lacking := len(set(cell.seeds) - self.seeds))
        ]


def find_anchors(by_agent: Mapping[str, CellResults], ends: ScoreAnchors | None) -> tuple[Anchoring | None, list[str]]:
    """Return the anchors of a task, or None and the reason.

    Anchors count only if both are the package's own agents, with the information that these receive, and were run on
    the same unbroken block of seeds of a split. An agent that is absent is no reason worth a sentence.

    Args:
        by_agent: Results of the task.
        ends: Names of the anchors; None where the world has no score.
    """
    if ends is None or not {ends.lower, ends.upper} <= set(by_agent):
        return None, []
    lower, upper = by_agent[ends.lower], by_agent[ends.upper]
    for cell in (lower, upper):
        own = AGENTS[cell.agent].requires
        if set(cell.card.get("requires", ())) != own:
            given = ", ".join(cell.card.get("requires", ())) or "nothing"
            return None, [
                f"No scores: {cell.agent} received {given} beyond the observation, the package's agent of this name "
                f"{', '.join(sorted(own)) or 'nothing'}."
            ]
        if column_of(cell, ends.column) is None:
            return None, [f"No scores: episodes of {cell.agent} have no {ends.column}."]
    common = sorted(set(lower.seeds) & set(upper.seeds))
    if not common or not _is_unbroken(common):
        return None, [
            f"No scores: {ends.lower} and {ends.upper} need the same seeds without gaps, and have {len(common)} in "
            f"common of {len(lower.rows)} and {len(upper.rows)}; evaluate both on as many episodes."
        ]
    errors = [np.array([row[ends.column] for row in cell.select(common)]) for cell in (lower, upper)]
    try:
        statistics.score(errors[0], errors[0], errors[1])
    except ValueError as error:
        return None, [f"No scores: {ends.lower} is not worse than {ends.upper} here ({error})."]
    return Anchoring(ends, frozenset(common), errors[0], errors[1]), []


def column_of(cell: CellResults, name: str) -> Array | None:
    """A column of the rows, if all of them have it."""
    if any(name not in row for row in cell.rows):
        return None
    return np.array([row[name] for row in cell.rows])


def _is_unbroken(seeds: Sequence[int]) -> bool:
    """Return True if the seeds lie in the known splits, as one block in each."""
    within = [[seed for seed in seeds if seed in split] for split in SPLITS.values()]
    blocks = [block for block in within if block]
    return sum(map(len, blocks)) == len(seeds) and all(block[-1] - block[0] == len(block) - 1 for block in blocks)
