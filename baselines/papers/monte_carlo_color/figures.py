"""Figures of monte_carlo_color: success curves, tracked frames as in figure 4, and parameter sensitivity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.papers.monte_carlo_color.experiment import (
    DEVIATIONS,
    HUES,
    MEAN_SHIFT,
    MIL,
    PAPER,
    PARTICLES,
    PLUS,
    SAMPLES,
    SLOW_TRACKERS,
    THRESHOLDS,
    TRACKERS,
    Measures,
    deviation_name,
    samples_name,
    threshold_name,
)
from servotrack.baselines.papers.monte_carlo_color.findings import end_sizes, over_scenarios
from servotrack.baselines.reporting.figure import STYLE
from servotrack.baselines.tuning.color_films import film, track
from servotrack.envs.track.color.config import PAPER_SCENARIOS
from servotrack.envs.track.color.render import ANSWER, TRUTH, draw_box
from servotrack.envs.track.color.scoring import SUCCESS_THRESHOLDS, success_curve
from servotrack.estimators.types import Array, Labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES: dict[str, dict[str, Any]] = {
    PAPER: {"color": "#e4572e", "lw": 1.8},
    PLUS: {"color": "#12436d", "lw": 1.8},
    PARTICLES: {"color": "#f2a541", "lw": 1.2},
    MEAN_SHIFT: {"color": "#00798c", "lw": 1.2},
    HUES: {"color": "#8a8f98", "lw": 1.0, "ls": (0, (4, 1.5))},
    "OpenCV CamShift": {"color": "#8a8f98", "lw": 1.0, "ls": (0, (1, 1))},
    MIL: {"color": "#6d6a9c", "lw": 1.0, "ls": (0, (5, 1, 1, 1))},
}
_PLUS_COLOR = (64, 148, 235)
_SHOWN = 6
"""Number of frames per scenario in figure 4."""
_ENLARGED = 2


def draw_success(found: Mapping[str, Mapping[str, Measures]]) -> Figure:
    """Draw success curves of all trackers, one panel per scenario."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 5.4), layout="constrained")
        for panel, (axes, scenario) in enumerate(zip(figure.subplots(2, 3).flat, PAPER_SCENARIOS, strict=True)):
            for name in (*TRACKERS, *SLOW_TRACKERS):
                curve = np.mean([success_curve(iou) for iou in found[scenario][name].iou], axis=0)
                label = f"{name} (a tenth of the films)" if name in SLOW_TRACKERS else name
                axes.plot(SUCCESS_THRESHOLDS, curve, label=label, **STYLES[name])
            axes.set_title(f"{'abcdef'[panel]}   {scenario.replace('_', ' and ')}")
            axes.set_xlim(0.0, 1.0)
            axes.set_ylim(0.0, 1.02)
            axes.grid(color="#e9e9e6", lw=0.5)
            if panel % 3 == 0:
                axes.set_ylabel("share of frames")
            if panel >= 3:
                axes.set_xlabel("overlap above")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    return figure


def draw_tracked(seed: int) -> Figure:
    """Draw frames of every scenario with the true box and the boxes of the paper's tracker and of its plus variant.

    Args:
        seed: Seed of level 0; level k uses seed + k.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 6.35))
        grid = figure.subplots(len(PAPER_SCENARIOS), _SHOWN)
        figure.subplots_adjust(left=0.035, right=0.995, top=0.945, bottom=0.005, wspace=0.03, hspace=0.04)
        for level, row in enumerate(grid):
            _draw_row(row, level, seed)
        keys = (("true box", TRUTH), (PAPER, ANSWER), (PLUS, _PLUS_COLOR))
        for number, (name, color) in enumerate(keys):
            shade = tuple(channel / 255.0 for channel in color)
            figure.text(0.06 + 0.17 * number, 0.968, "■", color=shade, fontsize=11, va="center", ha="right",
                        path_effects=_rim())  # fmt: skip
            figure.text(0.066 + 0.17 * number, 0.969, name, fontsize=8, va="center")
    return figure


def _rim() -> list[Any]:
    from matplotlib import patheffects

    return [patheffects.withStroke(linewidth=1.2, foreground="#444444")]


def _draw_row(row: Sequence[Axes], level: int, seed: int) -> None:
    # A different person in every scenario.
    seen = film(seed + level, level=level)
    paper, plus = (track(color_tracker(name), seen).boxes for name in ("monte-carlo-color", "monte-carlo-color-plus"))
    chosen = np.linspace(0, len(seen.frames) - 1, len(row) + 1).astype(int)[1:]
    if PAPER_SCENARIOS[level] == "occlusion":
        chosen = _frames_around_first_jump(paper, seen.boxes, len(row))
    for axes, k in zip(row, chosen, strict=True):
        image = _enlarged(seen.frames[k])
        for boxes, color in ((seen.boxes, TRUTH), (plus, _PLUS_COLOR), (paper, ANSWER)):
            draw_box(image, _ENLARGED * boxes[k], color, 3)
        axes.imshow(image, interpolation="antialiased")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
        axes.text(0.03, 0.05, f"{k}", transform=axes.transAxes, fontsize=6, color="white", path_effects=_rim())
    row[0].set_ylabel(PAPER_SCENARIOS[level].replace("_", " and "), fontsize=7)


def _frames_around_first_jump(boxes: Array, truth: Array, count: int) -> Labels:
    """Frames around the first jump of the answer away from the truth, or around the middle of the film."""
    apart = np.abs(boxes[:, :2] - truth[:, :2]).max(axis=1)
    first = int(np.argmax(apart > 12.0)) if (apart > 12.0).any() else len(truth) // 2
    start = int(np.clip(first - 6, 0, len(truth) - 6 * count))
    return start + 6 * np.arange(count)


def _enlarged(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = frame.shape[:2]
    size = (_ENLARGED * width, _ENLARGED * height)
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def draw_sensitivity(found: Mapping[str, Mapping[str, Measures]]) -> Figure:
    """Draw AUC of the paper's tracker, and its box size at the end, against sigma_0, update threshold and samples."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    panels = (
        ("a   $\\sigma_0$ of eq. (11)", [f"{v:g}" for v in DEVIATIONS], [deviation_name(v) for v in DEVIATIONS]),
        ("b   update above similarity", [*(f"{v:g}" for v in THRESHOLDS[:-1]), "never"],
         [threshold_name(v) for v in THRESHOLDS]),
        ("c   number of samples", [str(v) for v in SAMPLES], [samples_name(v) for v in SAMPLES]),
    )  # fmt: skip
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 2.5), layout="constrained")
        figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr, call-arg]
        for axes, (title, labels, names) in zip(figure.subplots(1, 3, sharey=True), panels, strict=True):
            places = np.arange(len(names))
            for label, color, values in (
                ("AUC", "#e4572e", [bootstrap_mean(over_scenarios(found, name)) for name in names]),
                ("size of the box / true size", "#5f6b7a", [bootstrap_mean(end_sizes(found, name)) for name in names]),
            ):
                value, low, high = np.array(values).T
                axes.fill_between(places, low, high, color=color, alpha=0.15, lw=0)
                axes.plot(places, value, color=color, marker="o", ms=3.5, lw=1.4, label=label)
            axes.axhline(1.0, color="#999999", lw=0.6, ls=(0, (4, 3)), zorder=0)
            axes.set_title(title)
            axes.set_xticks(places, labels)
            axes.set_ylim(bottom=0.0)
            axes.grid(axis="y", color="#e9e9e6", lw=0.5)
        figure.axes[0].legend(fontsize=6.5, frameon=False)
    return figure
