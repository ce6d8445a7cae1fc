"""Scores of the duel, computed from the rows: one function decides what a score is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotrack.baselines.evaluation import statistics
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.duel.cells import Cell, Columns
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


def score_episodes(cell: Cell, columns: Columns, lower: Columns, upper: Columns) -> Array:
    """Return the score of each episode; larger is better.

    Args:
        cell: The cell.
        columns: Numbers of the episodes to score.
        lower: Those of the lower anchor on the same seeds, see `ScoreAnchors`.
        upper: Those of the upper anchor.

    Returns:
        In worlds with anchors, `statistics.score` of the error; in the others the metric that ranks agents, with its
        sign turned where less is better. Shape (K,).
    """
    anchors, headline = cell.world.anchors, cell.world.headline
    if anchors is None:
        return (1.0 if headline.high_is_good else -1.0) * np.array(columns[headline.column], np.float64)
    errors, low, high = (np.array(part[anchors.column], np.float64) for part in (columns, lower, upper))
    return statistics.score(np.maximum(errors, anchors.least_share * high.min()), low, high)


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
    anchors = cell.world.anchors
    names = (anchors.lower, anchors.upper) if anchors else (rows[0].method, rows[0].method)
    ends = [groups.get((cell.title, name, 0 if anchors else rows[0].budget)) for name in names]
    if not all(ends):
        raise ResultsError(f"{cell.title} has no rows of {' and '.join(names)}; run them: scripts/duel run --methods")
    counts = {
        (len(row.test["return"]), len(row.held_out["return"])) for row in (*rows, *(end[0] for end in ends if end))
    }
    if len(counts) != 1:
        raise ResultsError(f"{cell.title} has rows of different numbers of episodes, {sorted(counts)}; run them again")

    def scores(part: str) -> Array:
        lower, upper = (getattr(end[0], part) for end in ends if end)
        return np.array([score_episodes(cell, getattr(row, part), lower, upper) for row in rows])

    def column(part: str, name: str) -> Array:
        return np.array([getattr(row, part)[name] for row in rows], np.float64)

    taken = [sum(row.steps.values()) for row in rows]
    searched = [row.steps["search"] for row in rows]
    return Entry(
        cell,
        rows[0].method,
        rows[0].information,
        rows[0].budget,
        scores("test"),
        column("test", "success"),
        column("test", cell.world.headline.column),
        scores("held_out"),
        column("held_out", "success"),
        max(taken),
        sum(searched) / max(1, sum(taken)),
        float(np.mean([row.seconds for row in rows])),
    )
