"""Tables and sentences about verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from servotrack.baselines.board.verification import Verdict
from servotrack.baselines.reporting.grid import Grid

_PARTS: tuple[Literal["public", "sealed", "fresh"], ...] = ("public", "sealed", "fresh")


def verdict_grids(verdicts: Sequence[Verdict]) -> Mapping[str, Grid]:
    """Return one table per suite: badge, confirmed cells, and mean scores over the levels of each world.

    Args:
        verdicts: Verdicts, refused ones included.
    """
    by_suite: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        by_suite.setdefault(verdict.suite, []).append(verdict)
    return {f"Suite {suite}" if suite else "Not submissions": _grid(group) for suite, group in by_suite.items()}


def _grid(verdicts: Sequence[Verdict]) -> Grid:
    worlds = list(dict.fromkeys(name.split(",")[0] for verdict in verdicts for name in verdict.cells))
    shown = [
        (world, part)
        for world in worlds
        for part in _PARTS
        if any(verdict.mean_score(world, part) is not None for verdict in verdicts)
    ]
    rows = []
    for verdict in sorted(verdicts, key=lambda verdict: -_rank(verdict, worlds)):
        states = [cell.state for cell in verdict.cells.values()]
        confirmed = sum(state in ("equal", "close") for state in states)
        scores = [verdict.mean_score(world, part) for world, part in shown]
        badge = "refused" if verdict.refused else "stale" if "stale" in states else verdict.badge
        cells = f"{confirmed}/{len(states)}"
        rows.append([verdict.name or verdict.folder, badge, cells, *("" if x is None else f"{x:.3f}" for x in scores)])
    return Grid(["agent", "badge", "cells equal", *(f"{world} {part}" for world, part in shown)], rows, 2)


def _rank(verdict: Verdict, worlds: Sequence[str]) -> float:
    score = verdict.mean_score(worlds[0], "public") if worlds else None
    return float("-inf") if score is None else score


def problems(verdicts: Sequence[Verdict]) -> list[str]:
    """Return one sentence for everything that is wrong."""
    lines = []
    for verdict in verdicts:
        if verdict.refused:
            lines.append(f"{verdict.folder} is refused: {verdict.refused}")
        lines += [f"{verdict.folder}: {note}" for note in verdict.notes]
        for name, cell in verdict.cells.items():
            if cell.state == "stale":
                lines.append(
                    f"{verdict.folder}, {name} is stale: the world is not that of suite {verdict.suite} any more"
                )
            elif cell.state == "different" or cell.detail:
                lines.append(f"{verdict.folder}, {name} differs: {cell.detail}")
    return lines
