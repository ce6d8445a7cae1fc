"""Scale of the score in one task: which episodes count, and why there is no score where there is none."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation import statistics
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.evaluation.seeds import SPLITS
from servotrack.baselines.worlds import EpisodeBound, ScoreAnchors, World, load
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Anchoring:
    """Errors between which a task's scores are scaled.

    Attributes:
        ends: Names, column, and the least share of an error.
        seeds: Seeds of the anchors' episodes, those that both have.
        lower: Errors of the agent without skill, shape (n,).
        upper: Bounds on the error, or errors of the agent that knows the system, shape (m,).
        bound: The bound, None where `upper` are errors of an agent.
    """

    ends: ScoreAnchors
    seeds: frozenset[int]
    lower: Array
    upper: Array
    bound: EpisodeBound | None = None

    def scores(self, cell: CellResults, errors: Array) -> Array | None:
        """Return a score per episode; None for an agent with episodes that the anchors lack.

        Args:
            cell: Results of the agent.
            errors: Error of each episode, shape (k,).
        """
        if not self.seeds.issuperset(cell.seeds):
            return None
        return self.scale(errors)

    def scale(self, errors: Array) -> Array:
        """Return the score of each error, shape (k,). Raises ValueError as `statistics.score` does."""
        # A resolution keeps tiny errors finite by itself.
        floor = 0.0 if self.bound else self.ends.least_share * float(self.upper.min())
        kept = np.maximum(errors, floor)
        return statistics.score(*(part + self.resolution for part in (kept, self.lower, self.upper)))

    @property
    def resolution(self) -> float:
        """Error that is added before logarithms; none where the score is scaled by an agent, as it always was."""
        return self.ends.resolution if self.bound else 0.0

    def checked(self) -> Anchoring:
        """Return itself. Raises ValueError unless the agent without skill is worse than the other end."""
        self.scale(self.lower)
        return self

    @property
    def _agents(self) -> tuple[str, ...]:
        return (self.ends.lower,) if self.bound else (self.ends.lower, self.ends.upper)

    def missing(self, cells: Iterable[CellResults]) -> list[str]:
        """Return a sentence for each agent that has no score because the anchors lack some of its episodes."""
        lack, them = ("lacks", "it") if self.bound else ("lack", "them")
        return [
            f"No score for {cell.agent}: {' and '.join(self._agents)} {lack} {lacking} of its {len(cell.rows)} "
            f"episodes; evaluate {them} on as many."
            for cell in cells
            if (lacking := len(set(cell.seeds) - self.seeds))
        ]


def find_anchors(by_agent: Mapping[str, CellResults], world: World) -> tuple[Anchoring | None, list[str]]:
    """Return the anchors of a task, or None and the reason.

    Agents count as anchors only if they are the package's own, with the information that these receive, and were run on
    the same unbroken block of seeds of a split. An agent that is absent is no reason worth a sentence.

    Args:
        by_agent: Results of the task.
        world: Record of the task's kind.
    """
    ends = world.anchors
    if ends is None or ends.lower not in by_agent:
        return None, []
    lower = by_agent[ends.lower]
    bound = world.bound_of(lower.env_id)
    if bound is not None and (bound.column != ends.column or bounds_of(lower, bound) is None):
        bound = None
    if bound is None and ends.upper not in by_agent:
        return None, []
    cells = [lower] if bound else [lower, by_agent[ends.upper]]
    for cell in cells:
        own = AGENTS[cell.agent].requires
        if set(cell.card.get("requires", ())) != own:
            given = ", ".join(cell.card.get("requires", ())) or "nothing"
            return None, [
                f"No scores: {cell.agent} received {given} beyond the observation, the package's agent of this name "
                f"{', '.join(sorted(own)) or 'nothing'}."
            ]
        if column_of(cell, ends.column) is None:
            return None, [f"No scores: episodes of {cell.agent} have no {ends.column}."]
    common = sorted(set.intersection(*(set(cell.seeds) for cell in cells)))
    if not common or not _is_unbroken(common):
        names, numbers = (" and ".join(str(part) for part in parts) for parts in (
            (cell.agent for cell in cells), (len(cell.rows) for cell in cells)
        ))  # fmt: skip
        return None, [
            f"No scores: {names} need the same seeds without gaps, and have {len(common)} in common of {numbers}; "
            "evaluate on as many episodes."
        ]
    lower_errors, *others = (np.array([row[ends.column] for row in cell.select(common)]) for cell in cells)
    upper_errors = others[0] if others else np.array(bounds_of(lower, bound))
    try:
        return Anchoring(ends, frozenset(common), lower_errors, upper_errors, bound).checked(), []
    except ValueError as error:
        return None, [
            f"No scores: {ends.lower} is not worse than {'the bound' if bound else ends.upper} here ({error})."
        ]


def bounds_of(cell: CellResults, bound: EpisodeBound | None) -> list[float] | None:
    """Bounds of an agent's first episodes, at most `bound.episodes`; None if the environment has none."""
    if bound is None or cell.env_id != bound.env_id:
        return None
    return bounds_on(bound, cell.env_kwargs, cell.seeds[: bound.episodes])


def bounds_on(bound: EpisodeBound, env_kwargs: Mapping[str, Any], seeds: Sequence[int]) -> list[float] | None:
    """Bounds of the episodes with these arguments of the environment and seeds; None if they have none."""
    return _bounds(bound.values, json.dumps(env_kwargs, sort_keys=True), tuple(seeds))


@lru_cache(maxsize=256)
def _bounds(values: str, env_kwargs: str, seeds: tuple[int, ...]) -> list[float] | None:
    """Bounds of episodes, which are the same for all agents; None if the environment has none."""
    found: list[float] | None = load(values)(json.loads(env_kwargs), seeds)
    return found


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
