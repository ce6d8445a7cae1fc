"""Figures 2 to 6 of the paper with the truth, and scores of every method against the signal-to-noise ratio."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servotrack.baselines.agents.sonar.catalog import sonar_tracker
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.papers.hmm_sonar.experiment import (
    CELL,
    HUNGARIAN,
    LATE,
    METHODS,
    NEAREST,
    OFFSETS,
    ROW,
    SIMULATIONS,
    VITERBI,
    Measures,
    draw_rows,
    simulation,
)
from servotrack.baselines.papers.hmm_sonar.findings import TONE, coverage, in_time
from servotrack.baselines.reporting.figure import STYLE
from servotrack.envs.drawing.plots import identity_color
from servotrack.envs.track.sonar.array_model import scene_model_of
from servotrack.envs.track.sonar.config import sonar_config
from servotrack.envs.track.sonar.render import paint_powers
from servotrack.envs.track.sonar.scene import SonarScene, draw_scene
from servotrack.estimators.sonar import BearingTrack
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


STYLES: dict[str, dict[str, Any]] = {
    ROW: {"color": "#12436d", "lw": 1.8},
    LATE: {"color": "#12436d", "lw": 1.2, "ls": (0, (3, 1.5))},
    CELL: {"color": "#e4572e", "lw": 1.8},
    VITERBI: {"color": "#f2a541", "lw": 1.2},
    NEAREST: {"color": "#8a8f98", "lw": 1.0, "ls": (0, (1, 1))},
    HUNGARIAN: {"color": "#00798c", "lw": 1.2},
}


class _Sample(NamedTuple):
    """One record of a variant, its targets, and the tracks found by row and by cell."""

    rows: Array
    scene: SonarScene
    averages: int
    row: list[BearingTrack]
    cell: list[BearingTrack]


def draw_paper(seed: int, variants: tuple[str, ...] = SIMULATIONS) -> Figure:
    """Draw figures 2, 3 and 4 of the paper at its exact bearings and rates, one line of panels per variant.

    Args:
        seed: Seed of the noise.
        variants: Variants of `SonarTracking-v0`.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 2.75 * len(variants)), layout="constrained")
        grid = np.atleast_2d(figure.subplots(len(variants), 4, width_ratios=(1.0, 0.62, 1.0, 1.0)))
        for number, (line, variant) in enumerate(zip(grid, variants, strict=True)):
            sample = _sample(variant, seed)
            titles = ("figure 2", "figure 3", "figure 4, row", "figure 4, cell (paper)")
            for letter, axes, title in zip("abcdefgh"[4 * number :], line, titles, strict=False):
                axes.set_title(f"{letter}   {title}")
            _waterfall(line[0], sample)
            _presence(line[1], sample)
            for axes, followed in ((line[2], sample.row), (line[3], sample.cell)):
                _waterfall(axes, sample)
                _tracks(axes, sample, followed)
            line[0].set_ylabel(f"variant {variant}: time, s")
            for axes in line[1:]:
                axes.set_yticklabels([])
                axes.set_ylabel("")
    return figure


def draw_trial(seed: int) -> Figure:
    """Draw figures 5 and 6 of the paper on the substitute of its sea trial."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 3.6), layout="constrained")
        panels = figure.subplots(1, 3, sharey=True)
        sample = _sample("trial", seed)
        for axes, title in zip(
            panels, ("a   figure 5: record", "b   figure 6: row", "c   figure 6: cell (paper)"), strict=True
        ):
            _waterfall(axes, sample)
            axes.set_title(title)
        for axes, followed in ((panels[1], sample.row), (panels[2], sample.cell)):
            _tracks(axes, sample, followed)
            axes.set_ylabel("")
    return figure


def draw_offsets(found: Mapping[str, Mapping[str, Measures]]) -> Figure:
    """Draw coverage of the tone, crossings, starts and ends, and false tracks against the offset, for both variants."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    panels: tuple[tuple[str, Callable[[Measures], Array], float | None], ...] = (
        ("a   tone tracked, share of rows", lambda m: coverage(m, TONE), 1.02),
        ("b   both tracks kept through the crossing", lambda m: m.kept, 1.02),
        ("c   starts and ends within 1 s", in_time, 1.02),
        ("d   false tracks per run", lambda m: m.false_tracks, None),
    )
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 5.2), layout="constrained")
        for axes, (title, value, top) in zip(figure.subplots(2, 2).flat, panels, strict=True):
            for name in METHODS:
                means = [
                    bootstrap_mean(
                        np.concatenate([value(found[simulation(variant, offset)][name]) for variant in SIMULATIONS])
                    )
                    for offset in OFFSETS
                ]
                axes.plot(OFFSETS, [mean.value for mean in means], label=name, **STYLES[name])
                axes.fill_between(
                    OFFSETS,
                    [mean.low for mean in means],
                    [mean.high for mean in means],
                    color=STYLES[name]["color"],
                    alpha=0.10,
                    lw=0,
                )
            axes.set_title(title)
            axes.set_xlim(min(OFFSETS), max(OFFSETS))
            axes.set_xticks(OFFSETS)
            axes.set_ylim(0.0, top)
            axes.set_xlabel("offset of the signal-to-noise ratio, dB")
            axes.grid(color="#e9e9e6", lw=0.5)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    return figure


def _sample(variant: str, seed: int) -> _Sample:
    config = sonar_config(variant=variant, fidelity="snapshots", lag=0, bearing_jitter=0.0, rate_jitter=0.0)
    scene, model = draw_scene(config, seed), scene_model_of(config)
    rows = draw_rows(config, scene, seed)[: config.horizon]
    return _Sample(
        rows,
        scene,
        config.averages,
        sonar_tracker(METHODS[ROW], model).track(rows),
        sonar_tracker(METHODS[CELL], model).track(rows),
    )


def _waterfall(axes: Axes, sample: _Sample) -> None:
    length = len(sample.rows)
    image = paint_powers(sample.rows, sample.averages, (721, 4 * length))
    axes.imshow(image, extent=(0.0, 180.0, length, 0.0), aspect="auto", interpolation="antialiased")
    axes.set_xlim(0.0, 180.0)
    axes.set_xticks(range(0, 181, 45))
    axes.set_xlabel("bearing, deg")
    axes.set_ylabel("time, s")


def _tracks(axes: Axes, sample: _Sample, followed: list[BearingTrack]) -> None:
    """Draw tracks in identity colors, and the truth as dots every 4 s."""
    from matplotlib import patheffects

    for track in followed:
        axes.plot(
            track.bearings,
            track.first + np.arange(len(track.bearings)) + 0.5,
            color=_shade(track.label),
            lw=1.4,
            solid_capstyle="round",
            path_effects=[patheffects.withStroke(linewidth=2.4, foreground="#fdfcf9")],
        )
    length = len(sample.rows)
    for target in np.flatnonzero(sample.scene.exists.any(axis=0)):
        steps = np.flatnonzero(sample.scene.exists[:length, target])[:: max(length // 15, 1)]
        axes.plot(
            sample.scene.bearings[steps, target],
            steps + 0.5,
            ls="none",
            marker="o",
            ms=2.2,
            mfc="#fdfcf9",
            mec="#26323f",
            mew=0.5,
        )


def _presence(axes: Axes, sample: _Sample) -> None:
    """Draw the presence probability of each track over time (downwards), and true starts and ends as lines."""
    length = len(sample.rows)
    for track in sample.row:
        presence = np.zeros(length)
        presence[track.first : track.last + 1] = track.presence
        axes.plot(presence, np.arange(length) + 0.5, color=_shade(track.label), lw=1.3)
    for target in np.flatnonzero(sample.scene.exists.any(axis=0)):
        there = np.flatnonzero(sample.scene.exists[:length, target])
        for edge in (there[0], there[-1] + 1):
            axes.axhline(edge, color="#26323f", lw=0.5, ls=(0, (4, 3)))
    axes.axvline(0.5, color="#b9bcc0", lw=0.5)
    axes.set_ylim(length, 0.0)
    axes.set_xlim(-0.03, 1.03)
    axes.set_xticks((0.0, 0.5, 1.0))
    axes.set_xlabel("P(there)")


def _shade(label: int) -> tuple[float, ...]:
    return tuple(channel / 255.0 for channel in identity_color(label))
