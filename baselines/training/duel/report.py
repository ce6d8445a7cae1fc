"""Tables of the duel: every cell, the winners, crossovers, and aggregates over cells."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from servotrack.baselines.evaluation.statistics import (
    Interval,
    crossed_mean,
    crossed_methods_difference,
    probability_of_improvement,
    stratified_interquartile_mean,
)
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.training.comparison import MIN_RUNS
from servotrack.baselines.training.duel.methods import CLASSICAL, SHIPPED
from servotrack.baselines.training.duel.scoring import Entry


def ordered(entries: Sequence[Entry]) -> list[Entry]:
    """Return entries by cell, then budget, then falling score; reference agents first."""
    return sorted(entries, key=lambda e: (e.cell.env_id, e.cell.level, e.budget, -float(e.scores.mean())))


def cell_grid(entries: Sequence[Entry]) -> Grid:
    """Return the table of one cell."""
    metric = entries[0].cell.world.headline
    headings = [
        "method", "sees in training", "budget", "runs", "score", "success %", metric.title,
        "held-out score", "held-out success %", "search %", "CPU s",
    ]  # fmt: skip
    rows = []
    for entry in ordered(entries):
        rows.append(
            [
                entry.method,
                entry.information,
                _steps(entry.budget),
                str(entry.runs),
                shown(crossed_mean(entry.scores), 3),
                shown(crossed_mean(100.0 * entry.successes), 0),
                shown(crossed_mean(metric.factor * entry.errors), metric.digits),
                shown(crossed_mean(entry.held_out_scores), 3),
                shown(crossed_mean(100.0 * entry.held_out_successes), 0),
                f"{100.0 * entry.search_share:.0f}" if entry.budget else "",
                f"{entry.seconds:.0f}" if entry.budget else "",
            ]
        )
    return Grid(headings, rows, 2)


def winners_grid(entries: Sequence[Entry]) -> Grid:
    """Return who wins in each cell with each budget: every learned method against the classical one."""
    headings = [
        "cell", "budget", "learned method", "sees in training", "runs", "score, learned - classical",
        "success, learned - classical", "held-out score", "CPU, learned / classical", "winner",
    ]  # fmt: skip
    rows = []
    for learned in sorted(entries, key=lambda e: (e.cell.title, e.budget, -float(e.scores.mean()))):
        classical = _classical(entries, learned)
        if classical is None or learned.method == CLASSICAL:
            continue
        differences = [
            crossed_methods_difference(mine, other)
            for mine, other in (
                (learned.scores, classical.scores),
                (learned.successes, classical.successes),
                (learned.held_out_scores, classical.held_out_scores),
            )
        ]
        rows.append(
            [
                learned.cell.title,
                _steps(learned.budget),
                learned.method,
                learned.information,
                f"{learned.runs}, {classical.runs}",
                *(shown(difference, 3, signed=True) for difference in differences),
                f"{learned.seconds / max(classical.seconds, 0.1):.1f}",
                _winner(differences[0], learned, classical),
            ]
        )
    return Grid(headings, rows, 4)


def _classical(entries: Sequence[Entry], other: Entry) -> Entry | None:
    """Return the classical entry with the cell and the budget of another one, None if there is none."""
    wanted = (other.cell, other.budget, CLASSICAL)
    return next((entry for entry in entries if (entry.cell, entry.budget, entry.method) == wanted), None)


def _is_open(*entries: Entry) -> bool:
    return min(entry.runs for entry in entries) < MIN_RUNS


def _winner(difference: Interval, learned: Entry, classical: Entry) -> str:
    if _is_open(learned, classical):
        return f"open: fewer than {MIN_RUNS} runs"
    if difference.low > 0.0:
        return learned.method
    return classical.method if difference.high < 0.0 else "neither"


def crossover_grid(entries: Sequence[Entry]) -> Grid:
    """Return the budget from which each learned method is ahead of the classical one, by cell.

    Between two budgets the difference of the mean scores is interpolated over the logarithm of the budget.
    """
    rows = []
    for cell, method in sorted({(e.cell.title, e.method) for e in entries if e.budget and e.method != CLASSICAL}):
        mine = sorted((e for e in entries if (e.cell.title, e.method) == (cell, method)), key=lambda e: e.budget)
        pairs = [(entry, other) for entry in mine if (other := _classical(entries, entry)) is not None]
        if pairs:
            points = [(entry.budget, float(entry.scores.mean() - other.scores.mean())) for entry, other in pairs]
            seen = ", ".join(f"{_steps(budget)}: {difference:+.3f}" for budget, difference in points)
            is_open = any(_is_open(*pair) for pair in pairs)
            rows.append([cell, method, _crossing(points) + (" (open)" if is_open else ""), seen])
    return Grid(["cell", "method", "ahead of classical from", "difference at each budget"], rows, 2)


def _crossing(points: Sequence[tuple[int, float]]) -> str:
    if points[0][1] > 0.0:
        return f"{_steps(points[0][0])} or less"
    for (low, before), (high, after) in pairwise(points):
        if after > 0.0:
            share = before / (before - after)
            return f"{np.exp(np.log(low) + share * np.log(high / low)):,.0f}"
    return f"not up to {_steps(points[-1][0])}"


def aggregate_grid(entries: Sequence[Entry]) -> Grid:
    """Return aggregates over the cells in which a learned method and the classical one both have a budget.

    Columns: interquartile mean of the runs' scores, stratified by cell, for both in the same cells, and the probability
    that a run of the method has a larger mean score than a run of the classical one (`probability_of_improvement`).
    Intervals resample runs, so they are left out where a method has fewer than `MIN_RUNS` in a cell.
    """
    rows = []
    for budget, method in sorted({(e.budget, e.method) for e in entries if e.budget and e.method != CLASSICAL}):
        mine = [entry for entry in entries if (entry.budget, entry.method) == (budget, method)]
        pairs = [(entry, other) for entry in mine if (other := _classical(entries, entry)) is not None]
        if not pairs:
            continue
        learned, classical = [mine.of_runs for mine, _ in pairs], [other.of_runs for _, other in pairs]
        is_open = any(_is_open(*pair) for pair in pairs)
        found = [
            (stratified_interquartile_mean(learned), 3),
            (stratified_interquartile_mean(classical), 3),
            (probability_of_improvement(learned, classical), 2),
        ]
        rows.append(
            [
                method,
                _steps(budget),
                ", ".join(entry.cell.title for entry, _ in pairs),
                ", ".join(f"{entry.runs}/{other.runs}" for entry, other in pairs),
                *(f"{value.value:.{digits}f} (open)" if is_open else shown(value, digits) for value, digits in found),
            ]
        )
    headings = ["method", "budget", "cells", "runs", "IQM of scores", "IQM of classical", "P(better than classical)"]
    return Grid(headings, rows, 3)


def markdown(entries: Sequence[Entry], command: str, version: str) -> str:
    """Return all tables as Markdown.

    Args:
        entries: All entries.
        command: Command to name as the origin.
        version: Version of the code that computed the tables.
    """
    anchored = [entry for entry in entries if entry.cell.world.anchors]
    note = (
        "Brackets: 95 % bootstrap intervals, runs and episodes resampled, crossed; with one run, episodes alone. Open: "
        f"fewer than {MIN_RUNS} runs. Budget: environment steps of search and training together. Written by "
        f"`{command}`, servotrack {version}."
    )
    sections = [
        ("Who wins", as_markdown(winners_grid(entries))),
        ("Where the curves cross", as_markdown(crossover_grid(entries))),
        ("Over cells", as_markdown(aggregate_grid(anchored))),
    ]
    for cell in dict.fromkeys(entry.cell.title for entry in ordered(entries)):
        sections.append((cell, as_markdown(cell_grid([entry for entry in entries if entry.cell.title == cell]))))
    return "\n".join(f"### {title}\n\n{table}" for title, table in sections) + f"\n{note}\n"


def shown(interval: Interval, digits: int, signed: bool = False) -> str:
    """Return a number with its interval as text."""
    sign = "+" if signed else ""
    value, low, high = (f"{number:{sign}.{digits}f}" for number in interval)
    return f"{value} [{low}, {high}]"


def _steps(budget: int) -> str:
    return f"{budget:,}" if budget else "none"


def trained_entries(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that have a budget."""
    return [entry for entry in entries if entry.method not in SHIPPED]
