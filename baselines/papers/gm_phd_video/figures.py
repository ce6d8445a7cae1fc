"""Figures 2 and 3 of the paper: frames with detections and tracks, and the number of people over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.reporting.figure import STYLE
from servotrack.estimators.types import Image, Labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GRID = {"color": "#e9e9e6", "lw": 0.5}
_FILTERED, _UNFILTERED = "#b5121b", "#2f7ebc"


def draw_counts(numbers: Labels, counts: Mapping[str, Labels], frame_rate: float) -> Figure:
    """Draw figure 3: the true and the estimated number of people over time, one panel per method.

    Args:
        numbers: True number of people in each frame, shape (T,).
        counts: Reported number in each frame, keyed by method. Shape (T,).
        frame_rate: Frames per second.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 0.55 + 0.95 * len(counts)), layout="constrained")
        panels: NDArray[np.object_] = figure.subplots(len(counts), 1, sharex=True, squeeze=False)[:, 0]
        time = np.arange(len(numbers)) / frame_rate
        top = max([int(numbers.max(initial=0)), *(int(reported.max(initial=0)) for reported in counts.values())]) + 0.6
        for axes, (name, reported) in zip(panels.tolist(), counts.items(), strict=True):
            axes.grid(**_GRID)
            axes.set_axisbelow(True)
            color = _UNFILTERED if name.startswith("no filter") else _FILTERED
            axes.step(time, reported, where="post", color=color, lw=0.9, label="estimated")
            axes.step(time, numbers, where="post", color="#222222", lw=1.1, ls=(0, (4, 2)), label="real")
            axes.set(ylim=(-0.3, top), xlim=(0.0, float(time[-1]) if len(time) else 1.0), ylabel="people")
            axes.set_title(name)
        panels[-1].set_xlabel("time, s")
        panels[0].legend(loc="upper left", frameon=False, ncols=2, fontsize=7.0)
    return figure


def draw_frames(pictures: Sequence[tuple[str, Image, Image]]) -> Figure:
    """Draw figure 2: detections on the left, tracks on the right, at the frames that the paper shows.

    Args:
        pictures: Tuples of title, frame with detections, and frame with tracks.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 2.75 * len(pictures)), layout="constrained")
        panels = figure.subplots(len(pictures), 2, squeeze=False)
        for row, (title, detected, tracked) in zip(panels, pictures, strict=True):
            _show(row[0], detected, f"{title}: detections")
            _show(row[1], tracked, "tracks")
    return figure


def _show(axes: Axes, image: Image, title: str) -> None:
    axes.imshow(image)
    axes.set_title(title)
    axes.set_axis_off()
