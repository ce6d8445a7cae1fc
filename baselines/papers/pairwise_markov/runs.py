"""Runs of the pairwise_markov experiment in parallel, stored on disk in chunks, so that a second call resumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from servotrack.baselines.papers.pairwise_markov.experiment import METHODS, Condition, Measures, run_condition
from servotrack.baselines.papers.parts import Arrays, PartTask, compute_parts, read_part, setting_of

CHUNK = 25
"""Number of runs that are filtered as one batch and stored in one file."""


def run_all(
    conditions: Mapping[Condition, Sequence[int]] | Sequence[tuple[Condition, Sequence[int]]],
    folder: Path,
    progress: Progress,
    jobs: int = -1,
) -> dict[str, dict[str, Measures]]:
    """Return all runs of all conditions. Runs that `folder` already contains are read.

    Args:
        conditions: Conditions, each with its seeds.
        folder: Folder with one folder per condition and one file per chunk.
        progress: Progress display that gets a bar.
        jobs: Processes; -1 for all processors.

    Returns:
        Measurements by condition and method, in the order of the seeds.

    Raises:
        ResultsError: A file has another setting or version, or the folder cannot be written.
    """
    pairs = list(conditions.items()) if isinstance(conditions, Mapping) else list(conditions)
    chunks = [
        (condition, list(seeds[first : first + CHUNK]))
        for condition, seeds in pairs
        for first in range(0, len(seeds), CHUNK)
    ]
    paths = [_path(folder, condition, seeds) for condition, seeds in chunks]
    bar = progress.add_task("runs", total=sum(len(seeds) for _, seeds in chunks))
    missing = []
    for (condition, seeds), path in zip(chunks, paths, strict=True):
        if path.exists():
            progress.advance(bar, len(seeds))
        else:
            missing.append(PartTask(path, _setting(condition, seeds), _run_chunk, (condition, seeds)))
    for done in compute_parts(missing, jobs):
        progress.advance(bar, len(done.arguments[1]))
    found: dict[str, dict[str, list[Measures]]] = {}
    for (condition, seeds), path in zip(chunks, paths, strict=True):
        for method, measures in _read(path, condition, seeds).items():
            found.setdefault(condition.name, {}).setdefault(method, []).append(measures)
    return {
        name: {method: Measures(*map(np.concatenate, zip(*parts, strict=True))) for method, parts in methods.items()}
        for name, methods in found.items()
    }


def _path(folder: Path, condition: Condition, seeds: Sequence[int]) -> Path:
    return folder / condition.name / f"{seeds[0]}-{len(seeds)}.npz"


def _run_chunk(condition: Condition, seeds: list[int]) -> Arrays:
    measures = run_condition(condition, seeds)
    return {f"{method}/{key}": values for method, m in measures.items() for key, values in m._asdict().items()}


def _read(path: Path, condition: Condition, seeds: list[int]) -> dict[str, Measures]:
    stored = read_part(path, _setting(condition, seeds))
    return {method: Measures(*(stored[f"{method}/{key}"] for key in Measures._fields)) for method in condition.methods}


def _setting(condition: Condition, seeds: Sequence[int]) -> str:
    """Settings that a chunk's results depend on, in one line."""
    methods: dict[str, Any] = {name: [METHODS[name][0], asdict(METHODS[name][1])] for name in condition.methods}
    return setting_of(
        world=asdict(condition.config), methods=methods, trajectories=condition.trajectories, seeds=list(seeds)
    )
