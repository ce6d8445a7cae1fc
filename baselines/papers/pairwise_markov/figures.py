"""Figures 1 to 4 of the paper, and OSPA against detection probability and clutter rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.papers.pairwise_markov.experiment import Measures, SingleRun
from servotrack.baselines.reporting.figure import STYLE
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHOD_STYLES: dict[str, dict[str, Any]] = {
    "PHD-HMM": {"color": "#7fb4dd", "ls": (0, (3, 1.5))},
    "PHD-PMM": {"color": "#12436d"},
    "CBMeMBer-HMM": {"color": "#f2a541", "ls": (0, (3, 1.5))},
    "CBMeMBer-PMM": {"color": "#e4572e"},
    "PMB-HMM": {"color": "#a3b545", "ls": (0, (3, 1.5))},
    "PMB-PMM": {"color": "#386641"},
}
"""Line styles: PMM solid, HMM dashed, one hue per filter."""
_TRUTH = {"color": "#222222", "lw": 0.8}
_GRID = {"color": "#e9e9e6", "lw": 0.5}


def _figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, NDArray[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.grid(**_GRID)
        axes.set_axisbelow(True)
    return figure, panels.ravel()


def draw_truth(run: SingleRun, half_width: float) -> Figure:
    """Draw figure 1: true paths. Triangles mark their starts."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(3.6, 3.5)
        for path in run.truth:
            alive = path[~np.isnan(path[:, 0])]
            axes.plot(*alive.T, **_TRUTH)
            axes.plot(*alive[0], marker="^", ms=4, color="#b5121b", mec="white", mew=0.4)
        axes.set(xlim=(-half_width, half_width), ylim=(-half_width, half_width), xlabel="x, m", ylabel="y, m")
        axes.set_aspect("equal")
        axes.set_title("True paths (Zhang et al. 2017, figure 1)")
    return figure


def draw_estimates(run: SingleRun, name: str) -> Figure:
    """Draw figure 2: estimates of one run against time, per coordinate."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        figure, panels = _figure(7.2, 3.6, 2, 1)
        times = np.arange(1, len(run.estimates) + 1)
        when = np.repeat(times, [len(estimate) for estimate in run.estimates])
        where = np.concatenate(run.estimates)
        for axis, axes in enumerate(panels):
            axes.plot(run.clutter[:, 0], run.clutter[:, 1 + axis], ls="", marker=".", ms=1.2, color="#c9c9c4")
            for path in run.truth:
                axes.plot(times, path[:, axis], **_TRUTH)
            axes.plot(when, where[:, axis], ls="", marker="o", ms=1.8, color=METHOD_STYLES[name]["color"], mew=0)
            axes.set_ylabel(f"{'xy'[axis]}, m")
        panels[-1].set_xlabel("scan")
        panels[0].set_title(f"Estimates of {name}, one run; gray: measurements (Zhang et al. 2017, figure 2)")
    return figure


def draw_numbers(measures: Mapping[str, Measures], truth: Array) -> Figure:
    """Draw figure 3: mean and standard deviation of the extracted number; dotted, the filter's expected number."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        figure, panels = _figure(7.2, 1.55 * ((len(measures) + 1) // 2), (len(measures) + 1) // 2, 2)
        scans = np.arange(1, len(truth) + 1)
        for axes, (name, m) in zip(panels, measures.items(), strict=False):
            style = METHOD_STYLES[name]
            mean, deviation = m.number.mean(axis=0), m.number.std(axis=0)
            axes.fill_between(scans, mean - deviation, mean + deviation, color=style["color"], alpha=0.25, lw=0)
            axes.plot(scans, truth, **_TRUTH)
            axes.plot(scans, mean, color=style["color"], lw=1.1)
            axes.plot(scans, m.expected.mean(axis=0), color=style["color"], lw=0.9, ls=":")
            axes.set_title(name)
            axes.set_ylabel("targets")
        for axes in panels[-2:]:
            axes.set_xlabel("scan")
    return figure


def draw_errors(measures: Mapping[str, Measures]) -> Figure:
    """Draw figure 4: mean OSPA against time."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(7.2, 2.8)
        for name, m in measures.items():
            axes.plot(np.arange(1, m.ospa.shape[1] + 1), m.ospa.mean(axis=0), lw=1.1, label=name, **METHOD_STYLES[name])
        axes.set(xlabel="scan", ylabel="OSPA (c = 100 m, p = 1), m", ylim=(0, None))
        axes.legend(frameon=False, ncols=3)
        axes.set_title("OSPA (Zhang et al. 2017, figure 4)")
    return figure


def draw_sweep(
    values: Sequence[float], found: Sequence[Mapping[str, Measures]], methods: Sequence[str], label: str
) -> Figure:
    """Draw mean OSPA with standard errors against a parameter of the world."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(4.2, 2.8)
        for name in methods:
            runs = [measures[name].ospa.mean(axis=1) for measures in found]
            errors = [run.std(ddof=1) / np.sqrt(len(run)) for run in runs]
            axes.errorbar(
                values, [run.mean() for run in runs], errors, lw=1.1, capsize=2, label=name, **METHOD_STYLES[name]
            )
        axes.set(xlabel=label, ylabel="OSPA, m", ylim=(0, None))
        axes.legend(frameon=False)
    return figure
