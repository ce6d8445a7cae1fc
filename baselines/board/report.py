"""Tables and sentences about verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Literal

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.submission import Part
from servotrack.baselines.board.suites import load_suite, suite_names
from servotrack.baselines.board.verification import Verdict
from servotrack.baselines.reporting.grid import Grid

_PARTS: tuple[Part | Literal["fresh"], ...] = ("public", "sealed", "fresh")


def verdict_grids(verdicts: Sequence[Verdict]) -> Mapping[str, Grid]:
    """Return one table per suite: badge, confirmed cells, and mean scores over the levels of each world.

    Agents that lack cells come last; a mean over a part of a world's levels stands in brackets.

    Args:
        verdicts: Verdicts, refused ones included.
    """
    by_suite: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        by_suite.setdefault(verdict.suite, []).append(verdict)
    return {f"Suite {suite}" if suite else "Not submissions": _grid(group) for suite, group in by_suite.items()}


def _grid(verdicts: Sequence[Verdict]) -> Grid:
    totals = _totals(verdicts)
    shown = [
        (world, part)
        for world in totals
        for part in _PARTS
        if any(verdict.mean_score(world, part) is not None for verdict in verdicts)
    ]
    rows = []
    for verdict in sorted(verdicts, key=lambda verdict: _rank(verdict, totals)):
        states = [cell.state for cell in verdict.cells.values()]
        confirmed = sum(state in ("equal", "close") for state in states)
        badge = "refused" if verdict.refused else "stale" if "stale" in states else verdict.badge
        scores = [_shown(verdict, world, part, totals[world]) for world, part in shown]
        rows.append([_name(verdict), badge, f"{confirmed}/{sum(totals.values())}", *scores])
    return Grid(["agent", "badge", "cells", *(f"{world} {part}" for world, part in shown)], rows, 2)


def _name(verdict: Verdict) -> str:
    """Return the agent's name, with a dagger for one of this package that sees the truth."""
    privileged = verdict.kind == "registered" and agent_card(verdict.name).privileged
    return (verdict.name or verdict.folder) + (" †" if privileged else "")


def _totals(verdicts: Sequence[Verdict]) -> dict[str, int]:
    """Return the number of cells of each world of a suite, that of the verdicts where the suite is not a known one."""
    suite = verdicts[0].suite
    names = [cell.name for cell in load_suite(suite).cells] if suite in suite_names() else []
    names = names or list(dict.fromkeys(name for verdict in verdicts for name in verdict.cells))
    return dict(Counter(name.split(",")[0] for name in names))


def _cells(verdict: Verdict, world: str) -> int:
    return sum(name.split(",")[0] == world for name in verdict.cells)


def _shown(verdict: Verdict, world: str, part: Part | Literal["fresh"], total: int) -> str:
    score = verdict.mean_score(world, part)
    if score is None:
        return ""
    return f"{score:.3f}" if _cells(verdict, world) == total else f"({score:.3f})"


def _rank(verdict: Verdict, totals: Mapping[str, int]) -> tuple[bool, float]:
    world = next(iter(totals), "")
    score = verdict.mean_score(world, "public")
    return _cells(verdict, world) < totals.get(world, 0), -(float("-inf") if score is None else score)


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
