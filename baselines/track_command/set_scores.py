"""Scores of tracked sets against a truth: printed, and written as JSON and Markdown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.terminal import print_tables
from servotrack.estimators.metrics import gospa, ospa, ospa2
from servotrack.estimators.types import Array, Mask

SCORE_FILES = ("scores.json", "scores.md")
"""Names of the files of scores."""
_FORMAT_VERSION = 1


class SetScoring(NamedTuple):
    """Names, unit and cut-off of scores.

    Attributes:
        form: Name of the format of the JSON file.
        tracker: Name of the tracker.
        instants: Word for the times of the truth: scans, rows.
        unit: Unit of the distances.
        cutoff: Cut-off of the scores, in that unit.
    """

    form: str
    tracker: str
    instants: str
    unit: str
    cutoff: float


def write_set_scores(
    source: str, true: Array, found: Array, scoring: SetScoring, folder: Path, console: Console
) -> list[str]:
    """Score tracks, print the table and write it.

    Args:
        source: Name of the scored file.
        true: True places at the instants of the truth, NaN where absent. Shape (n, K, d).
        found: Reported ones. Shape (m, K, d).
        scoring: Names, unit and cut-off.
        folder: Folder for `SCORE_FILES`.
        console: Console for the table.

    Returns:
        Names of the files.
    """
    cutoff, unit = scoring.cutoff, scoring.unit
    sets = [(_present(true[:, k]), _present(found[:, k])) for k in range(true.shape[1])]
    scores = {
        "ospa": float(np.mean([ospa(a, b, cutoff) for a, b in sets])),
        "gospa": float(np.mean([gospa(a, b, cutoff, order=1.0).total for a, b in sets])),
        "ospa2": ospa2(true[_seen(true)], found[_seen(found)], cutoff),
        "count_error": float(np.mean([abs(len(a) - len(b)) for a, b in sets])),
    }
    headings = ["tracker", *(f"{name} {unit}" for name in ("OSPA", "GOSPA", "OSPA(2)")), "count error"]
    grid = Grid(headings, [[scoring.tracker, *(f"{value:.3g}" for value in scores.values())]], 1)
    note = (
        f"Cut-off {cutoff:.4g} {unit}, order 1, {len(sets)} {scoring.instants} of the truth, "
        f"{int(_seen(true).sum())} true tracks."
    )
    print_tables(console, {source: grid})
    console.print(note, style="dim", highlight=False)
    document = {
        "format": scoring.form,
        "version": _FORMAT_VERSION,
        "source": source,
        "cutoff": cutoff,
        scoring.instants: len(sets),
        "scores": scores,
        "provenance": provenance(),
    }
    texts = (json.dumps(document, indent=1) + "\n", f"{as_markdown(grid)}\n{note}\n")
    for name, text in zip(SCORE_FILES, texts, strict=True):
        with atomic_path(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return list(SCORE_FILES)


def _present(members: Array) -> Array:
    return members[~np.isnan(members[:, 0])]


def _seen(tracks: Array) -> Mask:
    """Mask of the tracks that exist at any time."""
    return np.asarray(~np.isnan(tracks[:, :, 0]).all(axis=1))
