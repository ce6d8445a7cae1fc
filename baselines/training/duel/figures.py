"""Figures of the duel: score against budget, and performance profiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.statistics import crossed_mean, performance_profile
from servotrack.baselines.reporting.figure import STYLE, save_figure
from servotrack.baselines.training.duel.methods import CLASSICAL, LEARNED, SHIPPED_PREFIX
from servotrack.baselines.training.duel.scoring import Entry

_COLORS = ("#222222", "#1f8a70", "#7bc8b4", "#c8553d", "#e3a18f", "#3d6cb9", "#8a5fb0", "#b08d2f", "#d14f9a")
_MARKERS = "osD^v<>P"
_NOT_DRAWN = ("random", "oracle")
"""Agents without skill, or with knowledge that no method has."""


def _look(method: str) -> tuple[str, str]:
    """Return color and marker of a method, the same in all figures."""
    names = (CLASSICAL, *LEARNED)
    i = names.index(method)
    return _COLORS[i % len(_COLORS)], _MARKERS[i % len(_MARKERS)]


def draw_budgets(entries: Sequence[Entry], path: Path) -> None:
    """Write curves of score and success over the budget, one column per cell, with intervals.

    Args:
        entries: All entries; agents without a budget are horizontal lines.
        path: File ending in .png or .svg.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    cells = sorted({entry.cell for entry in entries}, key=lambda cell: (cell.env_id, cell.level))
    budgets = [entry.budget for entry in entries if entry.budget]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(2.5 * len(cells) + 0.6, 4.6), layout="constrained")
        grid = figure.subplots(2, len(cells), squeeze=False, sharex="col")
        for column, cell in enumerate(cells):
            here = [entry for entry in entries if entry.cell == cell]
            for row, part in enumerate(("scores", "successes")):
                axes = grid[row, column]
                for method in dict.fromkeys(entry.method for entry in here if entry.budget):
                    points = sorted((e for e in here if e.method == method), key=lambda e: e.budget)
                    found = [crossed_mean(getattr(entry, part)) for entry in points]
                    color, marker = _look(method)
                    steps = [entry.budget for entry in points]
                    values = np.array([interval.value for interval in found])
                    ends = np.array([[i.value - i.low, i.high - i.value] for i in found]).T
                    axes.errorbar(
                        steps, values, np.maximum(ends, 0.0), color=color, marker=marker, markersize=4, linewidth=1.2,
                        elinewidth=0.8, capsize=2, label=method,
                    )  # fmt: skip
                for learned, dashes in ((False, "--"), (True, ":")):
                    shipped = [
                        entry
                        for entry in here
                        if not entry.budget
                        and entry.method not in _NOT_DRAWN
                        and entry.method.startswith(SHIPPED_PREFIX) == learned
                    ]
                    if shipped:
                        best = max(shipped, key=lambda entry: float(getattr(entry, part).mean()))
                        value = float(getattr(best, part).mean())
                        label = f"best {'learned' if learned else 'classical'} agent as shipped"
                        axes.axhline(value, color="#999999", linestyle=dashes, linewidth=0.9, label=label)
                axes.set_xscale("log")
                axes.set_xlim(0.7 * min(budgets), 1.4 * max(budgets))
                if row == 0:
                    axes.set_title(f"{cell.env_id}\nlevel {cell.level}")
                else:
                    axes.set_xlabel("environment steps")
                axes.set_ylim(-0.05 if row else min(-0.05, axes.get_ylim()[0]), 1.05 if row else None)
        grid[0, 0].set_ylabel("score")
        grid[1, 0].set_ylabel("success")
        shown: dict[str, Any] = {}
        for axes in grid.flat:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                shown.setdefault(label, handle)
        figure.legend(list(shown.values()), list(shown), loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    save_figure(figure, path)


def draw_profiles(entries: Sequence[Entry], path: Path) -> None:
    """Write performance profiles: the share of runs and episodes above a score, one panel per budget.

    Args:
        entries: Entries of cells whose world has a score. Only methods that ran in every cell of a budget are drawn.
        path: File ending in .png or .svg.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    budgets = sorted({entry.budget for entry in entries if entry.budget})
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.1 * len(budgets) + 0.4, 2.9), layout="constrained")
        panels = figure.subplots(1, len(budgets), squeeze=False, sharey=True)[0]
        for axes, budget in zip(panels, budgets, strict=True):
            here = [entry for entry in entries if entry.budget == budget]
            cells = {entry.cell for entry in here}
            thresholds = np.linspace(-0.2, 1.6, 181)
            for method in dict.fromkeys(entry.method for entry in here):
                mine = [entry for entry in here if entry.method == method]
                if {entry.cell for entry in mine} == cells:
                    profile = performance_profile([entry.scores for entry in mine], thresholds)
                    axes.plot(thresholds, profile, color=_look(method)[0], linewidth=1.3, label=method)
            axes.set(xlabel="score", title=f"{budget:,} steps, {len(cells)} cells", ylim=(-0.02, 1.02))
        panels[0].set_ylabel("share of episodes above")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    save_figure(figure, path)
