"""Plot the learning curves of several runs, with the classical agents as horizontal lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.reporting.figure import STYLE
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.training.run import TrainingCurve


def draw_curves(
    curves: Sequence[TrainingCurve], classical: Mapping[str, Mapping[str, float]], title: str, path: Path
) -> None:
    """Write a figure of each run's metric on the tune seeds over environment steps.

    Args:
        curves: Learning curve of each run.
        classical: Metrics of the classical agents by name.
        title: Title of the figure.
        path: A .png file.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    measure = "score" if all("score" in entry for curve in curves for entry in curve.entries) else "return"
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 2.9), layout="constrained")
        axes = figure.subplots()
        for i, curve in enumerate(curves):
            steps = 1e-6 * np.array([entry["steps"] for entry in curve.entries])
            values = [entry[measure] for entry in curve.entries]
            label = f"{len(curves)} runs" if i == 0 else None
            axes.plot(steps, values, color="#1f8a70", linewidth=1.2, alpha=0.8, label=label)
        shades = ("#222222", "#777777", "#aaaaaa", "#cccccc")
        ranked = sorted(classical.items(), key=lambda item: -item[1][measure])
        for (name, measures), shade in zip(ranked, shades, strict=False):
            label = f"{name} {measures[measure]:.3g}"
            axes.axhline(measures[measure], color=shade, linestyle="--", linewidth=1.0, label=label)
        axes.set(xlabel="million environment steps", ylabel=f"mean {measure} on tune seeds", title=title)
        # The axis covers the runs and the best classical agent; lines far below appear in the legend only.
        seen = [entry[measure] for curve in curves for entry in curve.entries]
        seen += [measures[measure] for _, measures in ranked[:1]]
        room = max(max(seen) - min(seen), 1e-3)
        axes.set_ylim(min(seen) - 0.6 * room, max(seen) + 0.1 * room)
        axes.legend(frameon=False, fontsize=7, loc="lower right")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")
