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
    """Return who wins in each cell with each budget: the best learned method against the classical one.

    The best learned method is the one with the largest mean score on the test seeds, which favors learning.
    """
    headings = [
        "cell", "budget", "sees in training", "best learned", "runs", "score, learned - classical",
        "success, learned - classical", "held-out score", "CPU, learned / classical", "winner",
    ]  # fmt: skip
    rows = []
    for cell, budget in sorted({(e.cell.title, e.budget) for e in entries if e.budget}):
        here = [entry for entry in entries if (entry.cell.title, entry.budget) == (cell, budget)]
        classical = next((entry for entry in here if entry.method == CLASSICAL), None)
        if classical is None:
            continue
        for information in ("observations", "simulator"):
            learned = [e for e in here if e.method != CLASSICAL and e.information == information]
            if not learned:
                continue
            best = max(learned, key=lambda entry: float(entry.scores.mean()))
            difference = crossed_methods_difference(best.scores, classical.scores)
            rows.append(
                [
                    cell,
                    _steps(budget),
                    information,
                    best.method,
                    f"{best.runs}, {classical.runs}",
                    shown(difference, 3, signed=True),
                    shown(crossed_methods_difference(best.successes, classical.successes), 3, signed=True),
                    shown(crossed_methods_difference(best.held_out_scores, classical.held_out_scores), 3, signed=True),
                    f"{best.seconds / max(classical.seconds, 0.1):.1f}",
                    _winner(difference, best, classical),
                ]
            )
    return Grid(headings, rows, 4)


def _winner(difference: Interval, learned: Entry, classical: Entry) -> str:
    if min(learned.runs, classical.runs) < MIN_RUNS:
        return f"open: fewer than {MIN_RUNS} runs"
    if difference.low > 0.0:
        return learned.method
    return classical.method if difference.high < 0.0 else "neither"


def crossover_grid(entries: Sequence[Entry]) -> Grid:
    """Return the budget from which each learned method is ahead of the classical one, by cell.

    Between two budgets the difference of the mean scores is interpolated over the logarithm of the budget.
    """
    rows = []
    for cell in sorted({entry.cell.title for entry in entries}):
        here = [entry for entry in entries if entry.cell.title == cell and entry.budget]
        classical = {entry.budget: float(entry.scores.mean()) for entry in here if entry.method == CLASSICAL}
        for method in dict.fromkeys(entry.method for entry in here if entry.method != CLASSICAL):
            points = sorted(
                (entry.budget, float(entry.scores.mean()) - classical[entry.budget])
                for entry in here
                if entry.method == method and entry.budget in classical
            )
            if points:
                rows.append([cell, method, *_crossing(points)])
    return Grid(["cell", "method", "ahead of classical from", "difference at each budget"], rows, 2)


def _crossing(points: Sequence[tuple[int, float]]) -> list[str]:
    seen = ", ".join(f"{_steps(budget)}: {difference:+.3f}" for budget, difference in points)
    if points[0][1] > 0.0:
        return [f"{_steps(points[0][0])} or less", seen]
    for (low, before), (high, after) in pairwise(points):
        if after > 0.0:
            share = before / (before - after)
            return [f"{np.exp(np.log(low) + share * np.log(high / low)):,.0f}", seen]
    return [f"not up to {_steps(points[-1][0])}", seen]


def aggregate_grid(entries: Sequence[Entry]) -> Grid:
    """Return aggregates over the cells in which a method and the classical one both have a budget.

    Columns: interquartile mean of the runs' scores, stratified by cell, and the probability that a run of the method
    has a larger mean score than a run of the classical method (`probability_of_improvement`).
    """
    rows = []
    for budget in sorted({entry.budget for entry in entries if entry.budget}):
        classical = {e.cell.title: e for e in entries if e.budget == budget and e.method == CLASSICAL}
        for method in dict.fromkeys(e.method for e in entries if e.budget == budget):
            mine = [e for e in entries if e.budget == budget and e.method == method and e.cell.title in classical]
            if not mine:
                continue
            against = [classical[entry.cell.title].of_runs for entry in mine]
            of_runs = [entry.of_runs for entry in mine]
            better = probability_of_improvement(of_runs, against)
            rows.append(
                [
                    method,
                    _steps(budget),
                    str(len(mine)),
                    ", ".join(str(entry.runs) for entry in mine),
                    shown(stratified_interquartile_mean(of_runs), 3),
                    "" if method == CLASSICAL else shown(better, 2),
                ]
            )
    return Grid(["method", "budget", "cells", "runs", "IQM of scores", "P(better than classical)"], rows, 1)


def markdown(entries: Sequence[Entry], command: str, version: str) -> str:
    """Return all tables as Markdown.

    Args:
        entries: All entries.
        command: Command to name as the origin.
        version: Version of the code that computed the tables.
    """
    anchored = [entry for entry in entries if entry.cell.world.anchors]
    note = (
        "Brackets: 95 % bootstrap intervals, runs and episodes resampled, crossed; references have one run. Budget: "
        f"environment steps of search and training together. Written by `{command}`, servotrack {version}."
    )
    sections = [
        ("Who wins", as_markdown(winners_grid(entries))),
        ("Where the curves cross", as_markdown(crossover_grid(entries))),
        ("Over all servo cells", as_markdown(aggregate_grid(anchored))),
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
