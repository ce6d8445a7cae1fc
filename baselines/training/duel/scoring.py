"""Scores of the duel, computed from the rows: one function decides what a score is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotrack.baselines.leaderboard.anchoring import Anchoring, bounds_on
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.duel.cells import Cell, Columns, test_seeds
from servotrack.baselines.training.duel.rows import DuelRow
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Entry:
    """All runs of a method in a cell with one budget. N runs of K test and H held-out episodes.

    Attributes:
        cell: The cell.
        method: Name of the method.
        information: Data that the method sees in training.
        budget: Environment steps of each run; 0 for a reference agent.
        scores: Scores, shape (N, K).
        successes: 1 for a successful episode, shape (N, K).
        errors: Metric of the cell's world, shape (N, K).
        held_out_scores: Scores in wider ranges, shape (N, H).
        held_out_successes: 1 for a successful episode in wider ranges, shape (N, H).
        steps: Environment steps taken, search included, largest of the runs.
        search_share: Share of these steps that the search took, mean of the runs.
        seconds: CPU time of search and training, s, mean of the runs.
    """

    cell: Cell
    method: str
    information: str
    budget: int
    scores: Array
    successes: Array
    errors: Array
    held_out_scores: Array
    held_out_successes: Array
    steps: int
    search_share: float
    seconds: float

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.scores)

    @property
    def of_runs(self) -> Array:
        """Mean score of each run, shape (N,)."""
        return self.scores.mean(axis=1)


def score_episodes(cell: Cell, columns: Columns, anchoring: Anchoring | None) -> Array:
    """Return the score of each episode; larger is better.

    Args:
        cell: The cell.
        columns: Numbers of the episodes to score.
        anchoring: Errors at the scores 0 and 1, as in the leaderboards; None in worlds without anchors.

    Returns:
        Score of the error; without anchors the metric that ranks agents, with its sign turned where less is better.
        Shape (K,).
    """
    headline = cell.world.headline
    if anchoring is None:
        return (1.0 if headline.high_is_good else -1.0) * np.array(columns[headline.column], np.float64)
    return anchoring.scale(np.array(columns[anchoring.ends.column], np.float64))


def entries_of(rows: Sequence[DuelRow]) -> list[Entry]:
    """Collect the runs of each method, cell and budget.

    Raises:
        ResultsError: A cell without its anchors, or runs on different numbers of episodes.
    """
    groups: dict[tuple[str, str, int], list[DuelRow]] = {}
    for row in rows:
        groups.setdefault((row.cell.title, row.method, row.budget), []).append(row)
    return [_entry(found, groups) for found in groups.values()]


def _entry(rows: list[DuelRow], groups: dict[tuple[str, str, int], list[DuelRow]]) -> Entry:
    cell = rows[0].cell
    references = [found[0] for (title, _, budget), found in groups.items() if (title, budget) == (cell.title, 0)]
    by_name = {row.method: row for row in references}
    counts = {(len(row.test["return"]), len(row.held_out["return"])) for row in (*rows, *references)}
    if len(counts) != 1:
        raise ResultsError(f"{cell.title} has rows of different numbers of episodes, {sorted(counts)}; run them again")

    def scores(part: str, env_kwargs: Mapping[str, Any]) -> Array:
        anchoring = _anchoring(cell, {name: getattr(row, part) for name, row in by_name.items()}, env_kwargs)
        return np.array([score_episodes(cell, getattr(row, part), anchoring) for row in rows])

    def column(part: str, name: str) -> Array:
        return np.array([getattr(row, part)[name] for row in rows], np.float64)

    taken = [sum(row.steps.values()) for row in rows]
    searched = [row.steps["search"] for row in rows]
    return Entry(
        cell,
        rows[0].method,
        rows[0].information,
        rows[0].budget,
        scores("test", cell.env_kwargs),
        column("test", "success"),
        column("test", cell.world.headline.column),
        scores("held_out", cell.held_out_kwargs),
        column("held_out", "success"),
        max(taken),
        sum(searched) / max(1, sum(taken)),
        float(np.mean([row.seconds for row in rows])),
    )


def _anchoring(cell: Cell, references: Mapping[str, Columns], env_kwargs: Mapping[str, Any]) -> Anchoring | None:
    """Return the scale of the leaderboards for the episodes of a cell, None in worlds without one.

    Args:
        cell: The cell.
        references: Numbers of the reference agents' episodes by name.
        env_kwargs: Arguments of the environment in these episodes.

    Raises:
        ResultsError: An anchor without rows.
    """
    ends = cell.world.anchors
    if ends is None:
        return None
    bound = cell.world.bound_of(cell.env_id)
    bounded = bound is not None and bound.column == ends.column
    needed = (ends.lower,) if bounded else (ends.lower, ends.upper)
    if lacking := [name for name in needed if name not in references]:
        raise ResultsError(
            f"{cell.title} has no rows of {' and '.join(lacking)}; run `scripts/duel run` with "
            f"--methods {' '.join(lacking)}"
        )
    lower, *others = (np.array(references[name][ends.column], np.float64) for name in needed)
    seeds = test_seeds(len(lower))
    if bound is None or not bounded:
        return Anchoring(ends, frozenset(seeds), lower, others[0]).checked()
    least = np.array(bounds_on(bound, env_kwargs, seeds), np.float64)
    return Anchoring(ends, frozenset(seeds), lower, least, bound).checked()
