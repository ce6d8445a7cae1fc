"""Figure of trajectories: paths with their start, end and uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from servotrack.baselines.reporting.figure import STYLE
from servotrack.estimators.rfs.trajectory import Trajectory
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ELLIPSES = 12
"""Largest number of ellipses along a path."""
_DEVIATIONS = 2.0
"""Half-axes of an ellipse, standard deviations."""
_CORNERS = 33


def draw_trajectories(
    trajectories: Sequence[Trajectory],
    position: Sequence[int] = (0, 2),
    measurements: Array | None = None,
    labels: tuple[str, str] = ("x", "y"),
) -> Figure:
    """Draw paths from a dot at the start to a cross at the end, with ellipses of two standard deviations.

    Args:
        trajectories: The trajectories.
        position: Entries of the state on the two axes.
        measurements: Measurements to show as gray dots. Shape (Z, 2); None: none.
        labels: Names of the axes, with units.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    entries = list(position)[:2]
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = _DEVIATIONS * np.stack([np.cos(angle), np.sin(angle)])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.0, 6.0), layout="constrained")
        axes = figure.add_subplot()
        if measurements is not None and len(measurements):
            axes.plot(measurements[:, 0], measurements[:, 1], ".", color="0.8", markersize=1.5, zorder=0)
        for k, one in enumerate(trajectories):
            color = f"C{k % 10}"
            path = one.states[:, entries]
            axes.plot(path[:, 0], path[:, 1], "-", color=color, linewidth=0.9)
            axes.plot(*path[0], "o", color=color, markersize=3.0)
            axes.plot(*path[-1], "x", color=color, markersize=4.0)
            for i in np.unique(np.linspace(0, len(one) - 1, _ELLIPSES).astype(int)):
                values, vectors = np.linalg.eigh(one.covariances[i][np.ix_(entries, entries)])
                ring = path[i][:, None] + vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
                axes.plot(*ring, "-", color=color, linewidth=0.4, alpha=0.6)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"{len(trajectories)} trajectories: dot start, cross end, ellipses two standard deviations")
    return figure
