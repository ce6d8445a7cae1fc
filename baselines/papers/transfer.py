"""Rank correlations of trackers between rendered people and the user's sequences, in four measures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import rankdata

from servotrack.baselines.agents.people.catalog import create_tracker
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.statistics import RESAMPLES, RESAMPLING_SEED
from servotrack.baselines.papers import sequences
from servotrack.baselines.papers.gm_phd_video.experiment import Method, run_methods, scores
from servotrack.baselines.papers.parts import Arrays, part, setting_of
from servotrack.baselines.papers.request import Recording, Request
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.grid import Grid, as_sections
from servotrack.baselines.reporting.terminal import command_line, print_tables, progress_bars
from servotrack.baselines.tuning.people_sequences import estimates, read_sequence, tracks_of
from servotrack.envs.track.files.mot_files import find_mot_folder
from servotrack.estimators.metrics import MotScores, centroid_distances, mot_scores
from servotrack.estimators.types import Array

DETECTORS = ("masked", "masked-paper", "mog2", "knn")
TRACKERS = ("no-filter", "kalman-hungarian", "gm-phd", "gm-phd-paper", "gm-cbmember", "pmb")
CONFIGURATIONS: Mapping[str, Method] = {
    f"{detector} + {tracker}": Method(detector, tracker) for detector, tracker in itertools.product(DETECTORS, TRACKERS)
}
SCENES: Mapping[str, dict[str, int]] = {"plain": {"level": 0}, "crowd": {"level": 2}, "light": {"level": 4}}
"""Rendered scenes that are compared with the user's sequences."""
FRAMES = 300
MEASURES: Mapping[str, str] = {"MOTA": "mota", "IDF1": "idf1", "HOTA": "hota", "switches": "identity_switches"}
"""Measures that rank, by their names in tables, with the field of `MotScores`."""
NOTE = (
    "Spearman's rank correlation over all pairs of detector and tracker, for sequences that hold only detections over "
    "the trackers (rendered: mean over the detectors). A match is a center within 0.6 of the true height. Identity "
    "switches are ranked as they are: a tracker that reports less switches less. Brackets: 95 % intervals, "
    "configurations resampled; in the column of all sequences, sequences resampled, too."
)

Ranked = dict[str, Array]
"""Values of the measures by sequence, shape (measures, configurations)."""


def reproduce(request: Request) -> None:
    """Rank all configurations on rendered scenes and on the user's sequences, and correlate the rankings.

    Args:
        request: Request; `runs` is the number of episodes per scene.
    """
    output, console = request.output, request.console
    folder = output / "transfer"
    rendered: Ranked = {}
    films: Ranked = {}
    detections: Ranked = {}
    with progress_bars() as progress:
        bar = progress.add_task("sequences", total=len(SCENES) * request.runs + len(request.recordings))
        for name, axes in SCENES.items():
            found = []
            for seed in seeds.take("test", request.runs):
                found.append(_stored(folder / name / f"{seed}.npz", {"horizon": FRAMES, **axes}, seed))
                progress.advance(bar)
            rendered[f"rendered: {name}"] = np.mean(found, axis=0)
        for recording in request.recordings:
            only_detections = holds_only_detections(recording)
            values = part(
                folder / sequences.part_name(recording),
                sequences.setting_of_recording(recording, configurations=CONFIGURATIONS, measures=list(MEASURES)),
                lambda recording=recording, only=only_detections: (  # type: ignore[misc]
                    _of_detections(recording) if only else _of_frames(sequences.recorded(recording))
                ),
            )
            (detections if only_detections else films)[_name_of(recording)] = _measures(values)
            progress.advance(bar)
    tables = _tables(rendered, films, detections)
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


def holds_only_detections(recording: Recording) -> bool:
    """Return True if a recording holds detections but no frames: a MOTChallenge folder without images, or files.

    Files are given as NAME=DETECTIONS,TRUTH,RATE, see `servotrack.baselines.tuning.people_sequences.read_sequence`.
    """
    if "=" in recording.source and not Path(recording.source).exists():
        return True
    folder = find_mot_folder(recording.source) if Path(recording.source).is_dir() else None
    return folder is not None and folder.images is None and folder.detections is not None


def _name_of(recording: Recording) -> str:
    """Name for tables: of files their NAME, else the last part of the path."""
    name, equals, _ = recording.source.partition("=")
    return name if equals and not Path(recording.source).exists() else Path(recording.source).name


def _document(tables: Mapping[str, Grid], runs: int, heading: str) -> str:
    """Return all tables as Markdown, with the command that wrote them. `heading` precedes each title."""
    return f"Written by `{command_line()}`, {runs} runs per scene. {NOTE}\n\n{as_sections(tables, heading)}"


def _stored(path: Path, axes: Mapping[str, Any], seed: int) -> Array:
    """Return the measures of a rendered scene, from its file if there is one. Shape (measures, configurations)."""
    setting = setting_of(axes=axes, seed=seed, configurations=CONFIGURATIONS, measures=list(MEASURES))
    return _measures(part(path, setting, lambda: _of_frames(sequences.rendered(seed, **axes))))


def _measures(arrays: Arrays) -> Array:
    return np.array([arrays[name] for name in MEASURES], np.float64)


def _of_frames(sequence: sequences.Sequence) -> Arrays:
    """Measures of every configuration."""
    outcomes = run_methods(sequence.frames, sequence.size, sequence.frame_rate, CONFIGURATIONS, sequence.background)
    return _rows([scores(outcomes[name], sequence.truth) for name in CONFIGURATIONS])


def _of_detections(recording: Recording) -> Arrays:
    """Measures of every tracker on given detections."""
    sequence = read_sequence(recording.source)
    found = []
    for name in TRACKERS:
        tracker = create_tracker(name, sequence.frame_size, sequence.frame_rate)
        tracks = tracks_of(estimates(tracker, sequence))
        found.append(mot_scores(sequence.truth, tracks, centroid_distances, 1.2, 0.5))
    return _rows(found)


def _rows(found: Sequence[MotScores]) -> Arrays:
    return {name: np.array([getattr(one, field) for one in found], np.float64) for name, field in MEASURES.items()}


def by_tracker(values: Array) -> Array:
    """Return the mean over detectors of values of all configurations. Shapes (..., configurations), (..., trackers)."""
    return values.reshape(*values.shape[:-1], len(DETECTORS), len(TRACKERS)).mean(axis=-2)


def _tables(rendered: Ranked, films: Ranked, detections: Ranked) -> dict[str, Grid]:
    everything = {**rendered, **films}
    tables = {}
    for number, measure in enumerate(MEASURES):
        columns = [*everything, *([f"all {len(films)} films"] if len(films) > 1 else [])]
        rows = []
        for name, values in everything.items():
            row = [name]
            row += [
                "" if name == other else rank_correlation(values[number], others[number])
                for other, others in everything.items()
            ]
            if len(films) > 1:
                rest = [found[number] for other, found in films.items() if other != name]
                row.append(mean_rank_correlation(values[number], rest))
            rows.append(row)
        tables[f"Rank correlation of {measure}, detectors and trackers"] = Grid(["scene", *columns], rows, 1)
    if detections:
        everything = {name: by_tracker(values) for name, values in {**rendered, **films}.items()} | detections
        for number, measure in enumerate(MEASURES):
            rows = []
            for name, values in everything.items():
                rest = [found[number] for other, found in detections.items() if other != name]
                row = [rank_correlation(values[number], found[number]) if name != other else ""
                       for other, found in detections.items()]  # fmt: skip
                rows.append([name, *row, mean_rank_correlation(values[number], rest) if rest else ""])
            headings = ["scene", *detections, f"all {len(detections)} sequences"]
            tables[f"Rank correlation of {measure}, trackers on given detections"] = Grid(headings, rows, 1)
    tables["Measures of all configurations: MOTA / IDF1 / HOTA / switches"] = _ranking({**rendered, **films})
    if detections:
        tables["Measures of all trackers on given detections: MOTA / IDF1 / HOTA / switches"] = _values(
            list(TRACKERS), detections
        )
    return tables


def rank_correlation(first: Array, second: Array) -> str:
    """Return Spearman's rank correlation with a bootstrap interval over configurations."""
    return mean_rank_correlation(first, [second])


def mean_rank_correlation(one: Array, others: Sequence[Array]) -> str:
    """Return the mean of Spearman's rank correlations with several sequences, and a bootstrap interval.

    Args:
        one: Values of the configurations in a scene. Shape (k,).
        others: Values in other sequences; from two on sequences are resampled beside configurations, crossed.
    """
    value = float(np.mean([_correlations(one[None], other[None])[0] for other in others]))
    rng = np.random.default_rng(RESAMPLING_SEED)
    chosen = rng.integers(0, len(one), (RESAMPLES, len(one)))
    drawn = rng.integers(0, len(others), (RESAMPLES, len(others)))
    each = np.array([_correlations(one[chosen], other[chosen]) for other in others])
    with np.errstate(invalid="ignore"):
        low, high = np.nanpercentile(each[drawn, np.arange(RESAMPLES)[:, None]].mean(axis=1), [2.5, 97.5])
    return f"{value:+.2f} [{low:+.2f}, {high:+.2f}]"


def _correlations(first: Array, second: Array) -> Array:
    """Spearman's rank correlation of each row; NaN where one of the two is constant. Shapes (n, k), (n,)."""
    ranks = [rankdata(values, axis=1) for values in (first, second)]
    centered = [values - values.mean(axis=1, keepdims=True) for values in ranks]
    norms = np.sqrt((centered[0] ** 2).sum(axis=1) * (centered[1] ** 2).sum(axis=1))
    return np.divide((centered[0] * centered[1]).sum(axis=1), norms, out=np.full(len(norms), np.nan), where=norms > 0.0)


def _ranking(ranked: Ranked) -> Grid:
    order = np.argsort(-np.mean([values[0] for values in ranked.values()], axis=0), kind="stable").tolist()
    names = list(CONFIGURATIONS)
    return _values([names[i] for i in order], {name: values[:, order] for name, values in ranked.items()})


def _values(names: Sequence[str], ranked: Ranked) -> Grid:
    rows = [
        [name, *("{:.2f} / {:.2f} / {:.2f} / {:.0f}".format(*values[:, i]) for values in ranked.values())]
        for i, name in enumerate(names)
    ]
    return Grid(["configuration", *ranked], rows, 1)
