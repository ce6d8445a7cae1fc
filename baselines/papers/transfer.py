"""Rank correlation of trackers between rendered people and the user's sequences."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.statistics import RESAMPLES, RESAMPLING_SEED
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.gm_phd_video.experiment import Method, run_methods, scores
from servotrack.baselines.papers.parts import part, setting_of
from servotrack.baselines.papers.request import Request
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_sections
from servotrack.baselines.reporting.terminal import command_line, print_tables, progress_bars
from servotrack.estimators.types import Array

DETECTORS = ("masked", "masked-paper", "mog2", "knn")
TRACKERS = ("no-filter", "kalman-hungarian", "gm-phd", "gm-phd-paper", "gm-cbmember", "pmb")
CONFIGURATIONS: Mapping[str, Method] = {
    f"{detector} + {tracker}": Method(detector, tracker) for detector, tracker in itertools.product(DETECTORS, TRACKERS)
}
SCENES: Mapping[str, dict[str, int]] = {"plain": {"level": 0}, "crowd": {"level": 2}, "light": {"level": 4}}
"""Rendered scenes that are compared with the user's sequences."""
FRAMES = 300
NOTE = (
    "Spearman's rank correlation of MOTA over all pairs of detector and tracker; a match is a center within 0.6 of the "
    "true height. Brackets: 95 % intervals, configurations resampled."
)


def reproduce(request: Request) -> None:
    """Rank all configurations on rendered scenes and on the user's sequences, and correlate the rankings.

    Args:
        request: Request; `runs` is the number of episodes per scene.
    """
    output, console = request.output, request.console
    folder = output / "transfer"
    ranked: dict[str, Array] = {}
    with progress_bars() as progress:
        bar = progress.add_task("sequences", total=len(SCENES) * request.runs + len(request.recordings))
        for name, axes in SCENES.items():
            found = []
            for seed in seeds.take("test", request.runs):
                found.append(_stored_mota(folder / name / f"{seed}.npz", {"horizon": FRAMES, **axes}, seed))
                progress.advance(bar)
            ranked[f"rendered: {name}"] = np.mean(found, axis=0)
        for recording in request.recordings:
            stored = part(
                folder / sequences.part_name(recording),
                sequences.setting_of_recording(recording, configurations=CONFIGURATIONS),
                lambda recording=recording: {"mota": _mota(sequences.recorded(recording))},  # type: ignore[misc]
            )
            ranked[f"yours: {recording.source}"] = stored["mota"]
            progress.advance(bar)
    tables = {"Rank correlation of MOTA": _correlations(ranked), "MOTA of all configurations": _ranking(ranked)}
    print_tables(console, tables)
    hint = "" if request.recordings else (
        " Without --source only rendered scenes are compared with each other. Add --source VIDEO --truth FILE for each "
        "of your sequences."
    )  # fmt: skip
    console.print(NOTE + hint, style="dim")
    with atomic_path(output / "transfer.md") as temporary:
        temporary.write_text(f"# Transfer\n\n{_document(tables, request.runs, '##')}", encoding="utf-8")
    console.print(str(output / "transfer.md"), soft_wrap=True)
    if request.into is not None:
        embed(_document(tables, request.runs, "###"), request.into, "transfer")
        console.print(str(request.into), soft_wrap=True)


def _document(tables: Mapping[str, Grid], runs: int, heading: str) -> str:
    """Return all tables as Markdown, with the command that wrote them. `heading` precedes each title."""
    return f"Written by `{command_line()}`, {runs} runs per scene. {NOTE}\n\n{as_sections(tables, heading)}"


def _stored_mota(path: Path, axes: Mapping[str, Any], seed: int) -> Array:
    """Return `_mota` of a rendered scene, from its file if there is one."""
    setting = setting_of(axes=axes, seed=seed, configurations=CONFIGURATIONS)
    mota: Array = part(path, setting, lambda: {"mota": _mota(sequences.rendered(seed, **axes))})["mota"]
    return mota


def _mota(sequence: sequences.Sequence) -> Array:
    """MOTA of every configuration, shape (configurations,)."""
    outcomes = run_methods(sequence.frames, sequence.size, sequence.frame_rate, CONFIGURATIONS, sequence.background)
    return np.array([scores(outcomes[name], sequence.truth).mota for name in CONFIGURATIONS])


def _correlations(ranked: Mapping[str, Array]) -> Grid:
    names = list(ranked)
    rows = [
        [first, *("" if first == second else rank_correlation(ranked[first], ranked[second]) for second in names)]
        for first in names
    ]
    return Grid(["scene", *names], rows, 1)


def rank_correlation(first: Array, second: Array) -> str:
    """Return Spearman's rank correlation with a bootstrap interval over configurations."""
    value = float(spearmanr(first, second).statistic)
    chosen = np.random.default_rng(RESAMPLING_SEED).integers(0, len(first), (RESAMPLES, len(first)))
    resampled = [float(spearmanr(first[rows], second[rows]).statistic) for rows in chosen]
    low, high = np.nanpercentile(resampled, [2.5, 97.5])
    return f"{value:+.2f} [{low:+.2f}, {high:+.2f}]"


def _ranking(ranked: Mapping[str, Array]) -> Grid:
    order = np.argsort(-np.mean([values for values in ranked.values()], axis=0), kind="stable")
    names = list(CONFIGURATIONS)
    rows = [[names[i], *(f"{values[i]:.3f}" for values in ranked.values())] for i in order.tolist()]
    return Grid(["configuration", *ranked], rows, 1)
