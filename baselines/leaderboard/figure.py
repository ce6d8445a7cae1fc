"""The benchmark's figure: score and success of every agent against level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from servotrack.baselines.leaderboard.summary import TaskSummary
from servotrack.baselines.reporting.figure import STYLE
from servotrack.baselines.worlds import ScoreAnchors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FAMILY_COLORS = {
    "model-free": (
        "#12436d", "#2f7ebc", "#7fb4dd", "#00798c", "#57b8a5", "#5b8c3e", "#a3b545", "#6d6a9c", "#a79ccf", "#5f6b7a",
        "#a7b1bd",
    ),
    "structure": ("#b5121b", "#e4572e", "#f2a541", "#93356f"),
    "prior": ("#b5179e", "#7209b7", "#3a0ca3", "#f72585", "#4361ee", "#d98cb3"),
    "calibrated": ("#386641", "#12436d", "#b5121b", "#6a994e", "#2f7ebc", "#e4572e", "#93356f", "#f2a541", "#00798c"),
    "undeclared": ("#555555",),
    "privileged": ("#111111", "#777777"),
}  # fmt: skip
"""Cold colors for agents that know no model, warm ones for those that know the structure, black for the privileged."""
SUCCESS_COLORS = ("#ffffff", "#e4f1ee", "#a9d6cb", "#6bbcab")
"""From no success to nothing but success."""


def level_tasks(tasks: Sequence[TaskSummary], env_id: str | None = None) -> list[TaskSummary]:
    """Tasks of one id that differ by `level` alone, lowest first; the id with the most of them where none is given."""
    leveled = [task for task in tasks if task.level is not None and any(row.score for row in task.rows)]
    ids = [task.env_id for task in leveled]
    chosen = env_id or (max(ids, key=ids.count) if ids else None)
    return sorted((task for task in leveled if task.env_id == chosen), key=lambda task: task.level or 0)


def draw_levels(tasks: Sequence[TaskSummary]) -> Figure:
    """Mean score against level, one line per agent with its interval shaded, beside a key that gives the success rates.

    Args:
        tasks: Tasks of `level_tasks`, at least one.

    Raises:
        ValueError: No tasks.
    """
    if not tasks:
        raise ValueError("tasks must hold at least one servo task with a level, got none; run `servotrack bench`")
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = _names(tasks)
    styles = _styles(tasks, names)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, max(2.8, 1.0 + 0.17 * len(names))), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.55, 1.0))
        _draw_scores(left, tasks, names, styles)
        _draw_success(right, tasks, names, styles)
    return figure


def _anchors(tasks: Sequence[TaskSummary]) -> ScoreAnchors:
    """Anchors of the score; tasks with scores have them."""
    anchors = tasks[0].world.anchors
    assert anchors is not None
    return anchors


def _names(tasks: Sequence[TaskSummary]) -> list[str]:
    """Agents by their mean score over tasks, best first; the lower anchor is zero by definition and left out."""
    scores: dict[str, list[float]] = {}
    for task in tasks:
        for row in task.rows:
            if row.score is not None and row.agent != _anchors(tasks).lower:
                scores.setdefault(row.agent, []).append(row.score.value)
    return sorted(scores, key=lambda name: -float(np.mean(scores[name])))


def _styles(tasks: Sequence[TaskSummary], names: Sequence[str]) -> dict[str, dict[str, Any]]:
    information = {row.agent: row.information for task in tasks for row in task.rows}
    used: dict[str, int] = {}
    styles = {}
    for name in names:
        colors = FAMILY_COLORS.get(information[name], FAMILY_COLORS["undeclared"])
        index = used.get(information[name], 0)
        used[information[name]] = index + 1
        privileged = information[name] == "privileged"
        styles[name] = {
            "color": colors[index % len(colors)],
            "ls": "--" if privileged else "-",
            "lw": 1.1 if name == _anchors(tasks).upper else 1.4,
        }
    return styles


def _draw_scores(
    axes: Axes, tasks: Sequence[TaskSummary], names: Sequence[str], styles: dict[str, dict[str, Any]]
) -> None:
    for name in reversed(names):
        rows = [
            (task.level, row.score) for task in tasks if (row := task.row(name)) is not None and row.score is not None
        ]
        if not rows:
            continue
        levels = [float(level or 0) for level, _ in rows]
        mean, low, high = np.array([score for _, score in rows]).T
        axes.fill_between(levels, low, high, color=styles[name]["color"], alpha=0.13, lw=0)
        axes.plot(levels, mean, marker="o", ms=2.8, mec="white", mew=0.4, **styles[name])
    axes.axhline(1.0, color="#999999", lw=0.6, ls=(0, (4, 3)), zorder=0)
    anchoring = tasks[0].anchoring
    best = "the bound" if anchoring is not None and anchoring.bound else _anchors(tasks).upper_knows
    axes.set_title(f"a   Score: 0 random, 1 {best}")
    axes.set_ylabel("mean score, 95 % interval shaded")
    axes.set_xlabel("level")
    axes.set_xticks([task.level for task in tasks if task.level is not None])
    axes.grid(axis="y", color="#e9e9e6", lw=0.5)
    axes.set_axisbelow(True)


def _draw_success(
    axes: Axes, tasks: Sequence[TaskSummary], names: Sequence[str], styles: dict[str, dict[str, Any]]
) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    rates = np.full((len(names), len(tasks)), np.nan)
    for i, name in enumerate(names):
        for j, task in enumerate(tasks):
            row = task.row(name)
            if row is not None and row.success is not None:
                rates[i, j] = 100.0 * row.success.value
    colors = LinearSegmentedColormap.from_list("success", SUCCESS_COLORS)
    axes.imshow(rates, cmap=colors, vmin=0.0, vmax=100.0, aspect="auto")
    for (i, j), rate in np.ndenumerate(rates):
        if np.isfinite(rate):
            axes.text(j, i, f"{rate:.0f}", ha="center", va="center", fontsize=6.3, color="#22312e")
    axes.set_title("b   Success, % of episodes")
    axes.set_xlabel("level")
    axes.set_xticks(range(len(tasks)), [str(task.level) for task in tasks])
    # Names are text, not formulas, whatever dollar signs they hold.
    axes.set_yticks(range(len(names)), names, fontsize=7.2, parse_math=False)
    axes.tick_params(axis="both", length=0)
    axes.tick_params(axis="y", pad=25)
    axes.spines[:].set_visible(False)
    axes.set_xticks(np.arange(1, len(tasks)) - 0.5, minor=True)
    axes.set_yticks(np.arange(1, len(names)) - 0.5, minor=True)
    axes.grid(which="minor", color="white", lw=1.2)
    axes.tick_params(which="minor", length=0)
    for i, name in enumerate(names):
        # The key of panel a: a sample of the line between the agent's name and its row.
        axes.plot(
            [-0.14, -0.035], [i, i], transform=axes.get_yaxis_transform(), clip_on=False, solid_capstyle="butt",
            **styles[name],
        )  # fmt: skip
