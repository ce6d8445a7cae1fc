"""Figures 3 and 4 of the paper: path of the tool to a target at rest, and along a moving one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from servotrack.baselines.papers.unscented_jacobian.experiment import Run
from servotrack.baselines.reporting.figure import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TARGET_COLOR, START_COLOR = "#e4572e", "#12436d"
TOOL_COLORS = {"KF": "#2f7ebc", "PF": "#5b8c3e", "UKF": "#00798c", "UKF as printed": "#93356f"}


def draw_trajectories(runs: Mapping[str, Run], title: str) -> Figure:
    """Draw one panel per algorithm. As in the paper, a square marks the target and a circle the start of the tool.

    Args:
        runs: One run per algorithm, on the same episode.
        title: Title of the figure.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 2.0), layout="constrained")
        panels = figure.subplots(1, len(runs), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (name, run) in zip(panels, runs.items(), strict=True):
            axes.plot(*run.target.T, color=TARGET_COLOR, lw=0.9, ls=(0, (2, 1.5)), label="target")
            axes.plot(*run.tool.T, color=TOOL_COLORS[name], lw=0.8, label="tool")
            axes.plot(*run.target[0], marker="s", ms=5, color=TARGET_COLOR, mec="white", mew=0.5)
            axes.plot(*run.tool[0], marker="o", ms=5, color=START_COLOR, mec="white", mew=0.5)
            axes.set_aspect("equal")
            axes.margins(0.08)
            axes.set_title(name)
            axes.set_xlabel("x, m")
            axes.grid(color="#e9e9e6", lw=0.5)
            axes.set_axisbelow(True)
        panels[0].set_ylabel("y, m")
        figure.suptitle(title, x=0.01, ha="left", fontsize=8.5, color="#48566a")
    return figure
